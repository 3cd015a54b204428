"""Score against seconds, and scores by perturbation with their intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from hwp_bench.analysis.cost.curves import FrontPart, MeanCurve
from hwp_bench.analysis.statistics.bootstrap import Estimate
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.report.page.svg import (
    WIDTH,
    drawing,
    label,
    line,
    log_ticks,
    polyline,
    series,
    tag,
    ticks,
)

_LEFT, _RIGHT, _TOP, _BOTTOM = 44.0, WIDTH - 18.0, 14.0, 232.0
#: Height of one bar, and of the gap under a group.
_BAR, _GAP = 14.0, 22.0
#: Where bars begin.
_BARS = 8.0


def pareto_plot(
    curves: Sequence[MeanCurve],
    front: Sequence[FrontPart],
    metric: str,
    order: Mapping[str, int],
) -> Markup:
    """Draw mean validation score over the seconds of fitting, the front behind the curves.

    Args:
        curves: at least one.
        front: of the same curves.
        metric: of the scores.
        order: number of each method by label, for its colour.
    """
    facts = metric_facts(metric)
    start = min(float(curve.seconds[0]) for curve in curves)
    stop = max(float(curve.seconds[-1]) for curve in curves)
    stop = max(stop, start * 1.1)
    scores = [float(score) for curve in curves for score in curve.scores]
    span = max(max(scores) - min(scores), 1e-6)
    # Wide bands of few captures would press the curves flat, so the curves choose the range.
    low, high = min(scores) - 0.3 * span, max(scores) + 0.2 * span

    def x(seconds: float) -> float:
        share = math.log(seconds / start) / math.log(stop / start)
        return _LEFT + (_RIGHT - _LEFT) * min(max(share, 0.0), 1.0)

    def y(score: float) -> float:
        share = min(max((score - low) / (high - low), 0.0), 1.0)
        return _BOTTOM - (_BOTTOM - _TOP) * (share if facts.higher_is_better else 1 - share)

    parts = _frame(x, y, log_ticks(start, stop), ticks(low, high))
    by_label = {curve.label: curve for curve in curves}
    for part in front:
        curve = by_label[part.label]
        inner = [
            (float(s), float(v))
            for s, v in zip(curve.seconds, curve.scores, strict=True)
            if part.start < s < part.stop
        ]
        points = [(part.start, part.first_score), *inner, (part.stop, part.last_score)]
        parts.append(polyline([(x(s), y(v)) for s, v in points], "front"))
    for curve in curves:
        name = series(order[curve.label])
        if curve.low is not None and curve.high is not None:
            upper = [(x(s), y(v)) for s, v in zip(curve.seconds, curve.high, strict=True)]
            lower = [(x(s), y(v)) for s, v in zip(curve.seconds, curve.low, strict=True)]
            parts.append(polyline(upper + lower[::-1], f"band {name}", "polygon"))
        points = [(x(s), y(v)) for s, v in zip(curve.seconds, curve.scores, strict=True)]
        parts.append(polyline(points, f"curve {name}"))
        parts.append(tag("circle", cx=points[-1][0], cy=points[-1][1], r=4.0, class_=f"dot {name}"))
    unit = f" [{facts.unit}]" if facts.unit else ""
    parts.append(label(_LEFT, 9, f"{facts.label}{unit}, validation frames", class_="axis"))
    parts.append(label(_RIGHT, 262, "seconds of fitting (log)", "end", "axis"))
    return drawing(268, f"{facts.label} over seconds of fitting", parts)


def _frame(
    x: Callable[[float], float],
    y: Callable[[float], float],
    across: Sequence[float],
    up: Sequence[float],
) -> list[Markup]:
    parts = []
    for value in up:
        parts += [line(_LEFT, y(value), _RIGHT, y(value), "grid")]
        parts += [label(_LEFT - 5, y(value) + 4, f"{value:.5g}", "end")]
    for value in across:
        parts += [line(x(value), _BOTTOM, x(value), _BOTTOM + 4, "rule")]
        parts += [label(x(value), _BOTTOM + 16, f"{value:.3g}", "middle")]
    return [*parts, line(_LEFT, _BOTTOM, _RIGHT, _BOTTOM, "rule")]


@dataclass(frozen=True)
class Bar:
    """One method in one group of bars."""

    #: Number of the method, for its colour.
    method: int
    #: Its mean and interval.
    estimate: Estimate


def bar_plot(groups: Mapping[str, Sequence[Bar]], metric: str) -> Markup:
    """Draw one group of bars a perturbation, each with its 95 % interval.

    Bars begin at zero; an interval that leaves the picture is cut there, and has no end mark.

    Args:
        groups: by heading; at least one bar in all.
        metric: of the estimates.
    """
    facts = metric_facts(metric)
    values = [bar.estimate.value for bars in groups.values() for bar in bars]
    ends = [bar.estimate.high for bars in groups.values() for bar in bars]
    top = max([*values, 1e-9])
    high = min(max([top, *(end for end in ends if end is not None)]), 1.35 * top)
    right = WIDTH - 62.0

    def x(value: float) -> float:
        return _BARS + (right - _BARS) * min(max(value / high, 0.0), 1.0)

    parts: list[Markup] = []
    place = 14.0
    for heading, bars in groups.items():
        parts.append(label(_BARS, place, heading, class_="axis"))
        place += 6
        for bar in bars:
            estimate, name = bar.estimate, series(bar.method)
            parts.append(
                tag(
                    "rect",
                    x=_BARS,
                    y=place,
                    width=max(x(estimate.value) - _BARS, 0.5),
                    height=_BAR - 3,
                    class_=f"bar {name}",
                )
            )
            middle = place + (_BAR - 3) / 2
            if estimate.low is not None and estimate.high is not None:
                parts.append(line(x(estimate.low), middle, x(estimate.high), middle, "whisker"))
                for end in (estimate.low, estimate.high):
                    if 0 <= end <= high:
                        parts.append(line(x(end), middle - 4, x(end), middle + 4, "whisker"))
            text = f"{estimate.value:.{facts.digits}f}"
            parts.append(label(WIDTH - 2, middle + 4, text, "end"))
            place += _BAR
        place += _GAP - 4
    return drawing(place - 10, f"{facts.label} by perturbation with 95 % intervals", parts)
