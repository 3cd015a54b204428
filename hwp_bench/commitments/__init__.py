"""Hidden frames and seeds that their keeper is bound to: publications and sealed suites."""

from hwp_bench.commitments.publication import Publication, SealedPart, open_sealed, publish
from hwp_bench.commitments.recipe import SealedRecipe
from hwp_bench.commitments.suite import (
    Checked,
    SealedSuite,
    check_revealed,
    make_suite,
    reveal,
)

__all__ = [
    "Checked",
    "Publication",
    "SealedPart",
    "SealedRecipe",
    "SealedSuite",
    "check_revealed",
    "make_suite",
    "open_sealed",
    "publish",
    "reveal",
]
