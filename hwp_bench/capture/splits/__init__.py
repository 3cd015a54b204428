"""Splits: the frames that train, validate and test (contiguous 80/10/10), and their audit."""

from hwp_bench.capture.splits.audit import AuditReport, audit_split
from hwp_bench.capture.splits.split import (
    Split,
    contiguous_split,
    read_splits,
    split_for,
    write_splits,
)

__all__ = [
    "AuditReport",
    "Split",
    "audit_split",
    "contiguous_split",
    "read_splits",
    "split_for",
    "write_splits",
]
