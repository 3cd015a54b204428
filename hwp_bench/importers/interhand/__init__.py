"""InterHand2.6M: annotations, hands, capture."""

from hwp_bench.importers.interhand.from_interhand import InterHandImport, import_interhand
from hwp_bench.importers.interhand.sequences import (
    PAPER_SEQUENCES,
    InterHandSequence,
    find_sequence,
)

__all__ = [
    "PAPER_SEQUENCES",
    "InterHandImport",
    "InterHandSequence",
    "find_sequence",
    "import_interhand",
]
