"""A capture as a strip: scores of its test frames, and under them what disturbed the others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from hwp_bench.capture.schema import CaptureInfo
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.report.page.svg import (
    WIDTH,
    drawing,
    label,
    line,
    polyline,
    series,
    tag,
    ticks,
)
from hwp_bench.report.sources import TemporalWeights
from hwp_bench.results import CaptureResult
from hwp_bench.taxonomy import MAX_SEVERITY, perturbation

_LEFT, _RIGHT, _TOP, _BOTTOM = 44.0, WIDTH - 10.0, 16.0, 104.0
#: Height of a row of severities, and of the plot of temporal weights.
_ROW, _WEIGHTS = 13.0, 44.0


@dataclass(frozen=True)
class StripMethod:
    """One method on one capture."""

    #: Number of the method, for its colour.
    method: int
    #: Its label.
    label: str
    #: Its result.
    result: CaptureResult
    #: Its temporal weights by side; empty where it left none.
    weights: Mapping[str, TemporalWeights]


def strip_plot(methods: Sequence[StripMethod], info: CaptureInfo | None, metric: str) -> Markup:
    """Draw the strip of one capture.

    Args:
        methods: at least one; all with the same test frames.
        info: the capture; None leaves severities out.
        metric: of the scores.
    """
    frames = [frame.frame for frame in methods[0].result.frames]
    parts = _scores(methods, frames, metric)
    height = _BOTTOM + 18
    known = max(
        [max(item.frames) for m in methods for item in m.weights.values()] + [max(frames)],
        default=0,
    )
    count = info.frame_count if info else known + 1

    def x(frame: float) -> float:
        return _LEFT + (_RIGHT - _LEFT) * min(max(frame / count, 0.0), 1.0)

    if info is not None or any(method.weights for method in methods):
        # The test clip is drawn large above; this shows where in the capture it lies.
        low, high = x(min(frames)), x(max(frames) + 1)
        wedge = [(_LEFT, height), (_RIGHT, height), (high, height + 22), (low, height + 22)]
        parts.append(polyline(wedge, "wedge", "polygon"))
        height += 22
        parts.append(
            tag("rect", x=_LEFT, y=height, width=_RIGHT - _LEFT, height=4.0, class_="rail")
        )
        parts.append(tag("rect", x=low, y=height, width=high - low, height=4.0, class_="test"))
        height += 8
    if info is not None:
        rows, height = _severities(info, x, height)
        parts += rows
    for method in methods:
        for side, weights in method.weights.items():
            rows, height = _weights(method, side, weights, x, height)
            parts += rows
    if info is not None or any(method.weights for method in methods):
        parts += [
            label(x(tick), height + 10, f"{tick:g}", "middle") for tick in ticks(0, count - 1)[1:]
        ]
        parts.append(label(2, height + 10, "frame"))
        height += 16
    facts = metric_facts(metric)
    return drawing(height, f"{facts.label} of the test frames of {methods[0].result.id}", parts)


def _scores(methods: Sequence[StripMethod], frames: Sequence[int], metric: str) -> list[Markup]:
    facts = metric_facts(metric)
    values = [frame.scores[metric] for m in methods for frame in m.result.frames]
    span = max(max(values) - min(values), 10.0**-facts.digits)
    low, high = min(values) - 0.1 * span, max(values) + 0.1 * span

    def x(index: float) -> float:
        return _LEFT + (_RIGHT - _LEFT) * (index + 0.5) / len(frames)

    def y(score: float) -> float:
        return _BOTTOM - (_BOTTOM - _TOP) * (score - low) / (high - low)

    unit = f" [{facts.unit}]" if facts.unit else ""
    parts = [label(_LEFT, 10, f"{facts.label}{unit}, test frames", class_="axis")]
    for value in ticks(low, high, 4):
        parts += [line(_LEFT, y(value), _RIGHT, y(value), "grid")]
        parts += [label(_LEFT - 5, y(value) + 4, f"{value:.5g}", "end")]
    for method in methods:
        name = series(method.method)
        scored = method.result.frames
        points = [(x(i), y(frame.scores[metric])) for i, frame in enumerate(scored)]
        parts.append(polyline(points, f"curve {name}"))
        for (cx, cy), frame in zip(points, scored, strict=True):
            if frame.failure:
                parts.append(label(cx, cy + 4, "✕", "middle", "failed"))
            elif len(points) <= 60:
                parts.append(tag("circle", cx=cx, cy=cy, r=2.2, class_=f"dot {name}"))
    step = max(1, len(frames) // 6)
    for index in range(0, len(frames), step):
        parts.append(label(x(index), _BOTTOM + 13, str(frames[index]), "middle"))
    return [*parts, line(_LEFT, _BOTTOM, _RIGHT, _BOTTOM, "rule")]


def _severities(
    info: CaptureInfo, x: Callable[[float], float], height: float
) -> tuple[list[Markup], float]:
    parts: list[Markup] = []
    for name, values in info.perturbations.items():
        title = perturbation(name).title
        if values is None:
            parts.append(label(_LEFT, height + 10, f"{title}: severity unknown", class_="tick"))
            height += _ROW + 2
            continue
        parts.append(label(_LEFT, height + 9, f"{title}, severity 0 to {MAX_SEVERITY}"))
        height += 12
        for start, stop, severity in _runs(values):
            if severity:
                left, right = x(start), x(stop)
                parts.append(
                    tag(
                        "rect",
                        x=left,
                        y=height,
                        width=right - left,
                        height=_ROW - 3,
                        class_="severity",
                        fill_opacity=0.15 + 0.17 * severity,
                    )
                )
        parts.append(line(_LEFT, height + _ROW - 3, _RIGHT, height + _ROW - 3, "grid"))
        height += _ROW + 3
    return parts, height


def _runs(values: Sequence[int]) -> list[tuple[int, int, int]]:
    """Return (start, stop, value) of stretches of equal values."""
    runs: list[tuple[int, int, int]] = []
    for frame, value in enumerate(values):
        if runs and runs[-1][2] == value:
            runs[-1] = (runs[-1][0], frame + 1, value)
        else:
            runs.append((frame, frame + 1, value))
    return runs


def _weights(
    method: StripMethod,
    side: str,
    weights: TemporalWeights,
    x: Callable[[float], float],
    height: float,
) -> tuple[list[Markup], float]:
    top = max(weights.weights) or 1.0
    bottom = height + 12 + _WEIGHTS
    points = [
        (x(frame + 0.5), bottom - _WEIGHTS * value / top)
        for frame, value in zip(weights.frames, weights.weights, strict=True)
    ]
    where = f", {side} hand" if side else ""
    text = f"Temporal weight{where}, {method.label}: up to {top:.3g}"
    parts = [
        label(_LEFT, height + 9, text),
        polyline(points, f"curve {series(method.method)}"),
        line(_LEFT, bottom, _RIGHT, bottom, "grid"),
    ]
    return parts, bottom + 6
