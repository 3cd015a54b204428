"""Names of the suites of simulated captures, and which of them are of one size."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

#: The suites: those of the paper's captures, smallest first (`full-lite` has a twelfth of the
#: frames of `full`); then scenes as wide as the world,
#: for tuning (`wild-dev`) and for reports only (`wild-test`).
SUITES = ("smoke", "mini", "full-lite", "full", "wild-dev", "wild-test")
#: Suites whose captures have the frames and the size of another one: the preset that a method
#: has for that one fits them too.
SIZED_LIKE: Mapping[str, str] = MappingProxyType(
    {"full-lite": "full", "wild-dev": "mini", "wild-test": "mini"}
)
