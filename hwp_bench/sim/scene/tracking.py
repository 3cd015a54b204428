"""Settings of the estimator whose hand parameters a method gets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from hwp_bench.base.records import number


@dataclass(frozen=True)
class Estimator:
    """Errors of a landmark tracker and the fit to its landmarks, on top of those of the effects."""

    #: `tracker`: errors as measured on real landmarks.
    kind: Literal["tracker"]
    #: Factor on all of its errors; 1 is what was measured.
    scale: float = number(1.0, 0.0, 5.0)
    #: Chance of a gross failure in a frame. None was seen in 621 frames; (0 + 1) / (621 + 2).
    failures: float = number(0.0016, 0.0, 0.5)
