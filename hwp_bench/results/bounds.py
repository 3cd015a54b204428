"""How much a result may hold: sizes, and the range of each number, checked before it is used."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Annotated, Any

from msgspec import Meta

from hwp_bench.base.errors import UsageError
from hwp_bench.base.records import Count, Line, Seconds
from hwp_bench.metrics import METRICS

#: Largest result file that is read, bytes; one of 10,000 frames stays far below it.
MAX_BYTES = 64 << 20
#: Most captures of a result, frames of a capture, and points of a curve.
MAX_CAPTURES, MAX_FRAMES, MAX_CURVE = 1_000, 100_000, 10_000
#: Most metrics of a frame.
MAX_METRICS = 100
#: Most characters of the settings, the protocols or the environment as JSON.
MAX_TABLE = 500_000
#: Shortest time that a rate is computed from, s; below it a clock has measured nothing.
SHORTEST = 1e-9
# By how much a score may leave the range of its metric: sums are rounded.
_ROUNDING = 1e-9

#: Scores by metric; a metric that the toolkit knows has its own range, which is narrower.
ScoreTable = Annotated[
    dict[Line, Annotated[float, Meta(ge=-1e6, le=1e6)]], Meta(max_length=MAX_METRICS)
]
_Limit = Annotated[str, Meta(pattern=r"\A(?:seconds|steps)\Z", description="seconds or steps")]
#: Limits of a fit by name.
Limits = dict[_Limit, Count | Seconds | None]
#: A table of any values; `check_table` bounds all of it.
FreeTable = dict[Line, Any]


def check_scores(scores: Mapping[str, float]) -> None:
    """Refuse scores that their metric cannot have.

    Raises:
        UsageError: one is outside of its metric's range; the field names it.
    """
    for facts in METRICS:
        value = scores.get(facts.name)
        low, high = facts.range
        high = math.inf if high is None else high
        if value is not None and not low - _ROUNDING <= value <= high + _ROUNDING:
            limits = f"from {low:g} to {high:g}" if high < math.inf else f"at least {low:g}"
            raise UsageError(
                f"is {value:g}, but {facts.label} is {limits}", field=f"scores.{facts.name}"
            )


def check_table(value: Mapping[str, Any], name: str) -> None:
    """Refuse a table of any values that is too large to be shown.

    Raises:
        UsageError: it has more than `MAX_TABLE` characters.
    """
    if len(json.dumps(value)) > MAX_TABLE:
        raise UsageError(f"holds more than {MAX_TABLE:,} characters", field=name)


def per_second(count: int, seconds: float | None) -> float | None:
    """Return a rate; None where no time was measured, or one too short to divide by."""
    return None if seconds is None or seconds < SHORTEST else count / seconds
