"""A capture as a strip: scores of its test frames, and under them what disturbed the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING

from markupsafe import Markup

from hwp_bench.capture.schema import CaptureInfo
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.report.figures import (
    MARK,
    PALETTE,
    WIDTH,
    add_axes,
    figure_style,
    heading,
    new_figure,
    scale_up,
    series_style,
)
from hwp_bench.report.page.elements import inline_svg
from hwp_bench.report.sources import TemporalWeights
from hwp_bench.results import CaptureResult
from hwp_bench.taxonomy import MAX_SEVERITY, perturbation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Place of every panel, px: its left side and its width.
_LEFT, _ACROSS = 44.0, WIDTH - 54.0
#: Heights, px: the scores with their labels, the rail of the whole capture, a row of severities
#: and one of unknown ones, a plot of temporal weights, and the labels under the last of them.
_SCORES, _RAIL, _SEVERITY, _UNKNOWN, _WEIGHTS, _FOOT = 122.0, 30.0, 28.0, 16.0, 62.0, 16.0
#: Most test frames that get a dot each.
_DOTS = 60


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
    weights = [(method, side) for method in methods for side in method.weights]
    severities = dict(info.perturbations) if info else {}
    rows = {name: _UNKNOWN if v is None else _SEVERITY for name, v in severities.items()}
    seen = [max(method.weights[side].frames) for method, side in weights]
    count = info.frame_count if info else max([*frames, *seen], default=0) + 1
    below = info is not None or bool(weights)
    height = _SCORES
    if below:
        height += _RAIL + sum(rows.values()) + _WEIGHTS * len(weights) + _FOOT
    with figure_style():
        figure = new_figure(height)
        _draw_scores(figure, methods, frames, metric)
        top, axes = _SCORES, None
        if below:
            axes = _draw_rail(figure, top, count, min(frames), max(frames) + 1)
            top += _RAIL
        for name, values in severities.items():
            axes = _draw_severity(figure, top, name, values, count)
            top += rows[name]
        for method, side in weights:
            axes = _draw_weights(figure, top, method, side, count)
            top += _WEIGHTS
        if axes is not None:
            _number_frames(axes)
        title = f"{metric_facts(metric).label} of the test frames of {methods[0].result.id}"
        return inline_svg(figure, title)


def _draw_scores(
    figure: Figure, methods: Sequence[StripMethod], frames: Sequence[int], metric: str
) -> None:
    facts = metric_facts(metric)
    axes = add_axes(figure, _LEFT, 16, _ACROSS, 88)
    values = [frame.scores[metric] for method in methods for frame in method.result.frames]
    span = max(max(values) - min(values), 10.0**-facts.digits)
    scale_up(axes, min(values) - 0.1 * span, max(values) + 0.1 * span, 4)
    for method in methods:
        scores = [frame.scores[metric] for frame in method.result.frames]
        style = series_style(method.method)
        axes.plot(scores, **style)
        failed = [bool(frame.failure) for frame in method.result.frames]
        sound = [place for place, lost in enumerate(failed) if not lost]
        if sound and len(scores) <= _DOTS:
            heights = [scores[place] for place in sound]
            axes.plot(sound, heights, "o", markersize=4.4, color=style["color"])
        for place, lost in enumerate(failed):
            if lost:
                axes.text(place, scores[place], "✕", ha="center", va="center", size=13)
    axes.set_xlim(-0.5, len(frames) - 0.5)
    step = max(1, len(frames) // 6)
    axes.set_xticks(range(0, len(frames), step), [str(frame) for frame in frames[::step]])
    axes.tick_params(axis="x", labelbottom=True)
    unit = f" [{facts.unit}]" if facts.unit else ""
    heading(axes, f"{facts.label}{unit}, test frames")


def _draw_rail(figure: Figure, top: float, count: int, low: int, high: int) -> Axes:
    """Show where in the capture the test clip lies that is drawn large above."""
    from matplotlib.patches import Polygon, Rectangle

    axes = add_axes(figure, _LEFT, top, _ACROSS, 26)
    axes.spines[:].set_visible(False)
    axes.set(xlim=(0, count), ylim=(26, 0))
    corners = [(0, 0), (count, 0), (high, 22), (low, 22)]
    axes.add_patch(
        Polygon(
            corners, facecolor=PALETTE["shade"], edgecolor=PALETTE["line"], linewidth=0.7,
            gid=f"{MARK}wedge",
        )
    )  # fmt: skip
    for start, stop, name in ((0, count, "line"), (low, high, "test")):
        patch = Rectangle((start, 22), stop - start, 4, linewidth=0, facecolor=PALETTE[name])
        patch.set_gid(MARK + ("test" if name == "test" else "rail"))
        axes.add_patch(patch)
    return axes


def _draw_severity(
    figure: Figure, top: float, name: str, values: Sequence[int] | None, count: int
) -> Axes:
    from matplotlib.patches import Rectangle

    axes = add_axes(figure, _LEFT, top + 14, _ACROSS, 2 if values is None else 10)
    axes.spines["bottom"].set(color=PALETTE["line"], linewidth=0 if values is None else 0.7)
    axes.set(xlim=(0, count), ylim=(0, 1))
    known = f"severity 0 to {MAX_SEVERITY}" if values is not None else "severity unknown"
    _caption(axes, f"{perturbation(name).title}, {known}")
    start = 0
    for severity, group in groupby(values or ()):
        width = len(list(group))
        if severity:
            axes.add_patch(
                Rectangle(
                    (start, 0), width, 1, linewidth=0, facecolor=PALETTE["severity"],
                    alpha=min(0.15 + 0.17 * severity, 1.0), gid=f"{MARK}severity",
                )
            )  # fmt: skip
        start += width
    return axes


def _draw_weights(figure: Figure, top: float, method: StripMethod, side: str, count: int) -> Axes:
    weights = method.weights[side]
    axes = add_axes(figure, _LEFT, top + 14, _ACROSS, 44)
    axes.spines["bottom"].set(color=PALETTE["line"], linewidth=0.7)
    largest = max(weights.weights)
    axes.set(xlim=(0, count), ylim=(0, largest or 1.0))
    moments = [frame + 0.5 for frame in weights.frames]
    axes.plot(moments, weights.weights, clip_on=False, **series_style(method.method))
    where = f", {side} hand" if side else ""
    _caption(axes, f"Temporal weight{where}, {method.label}: up to {largest:.3g}")
    return axes


def _caption(axes: Axes, text: str) -> None:
    """Put a small line over axes."""
    axes.annotate(
        text, (0, 1), (0, 4), xycoords="axes fraction", textcoords="offset points",
        color=PALETTE["faint"], annotation_clip=False,
    )  # fmt: skip


def _number_frames(axes: Axes) -> None:
    """Put the numbers of the frames under the lowest panel."""
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10], integer=True, prune="lower"))
    axes.tick_params(axis="x", labelbottom=True)
    axes.annotate(
        "frame", (0, 0), (-42, -3), xycoords="axes fraction", textcoords="offset points", va="top",
        color=PALETTE["faint"], annotation_clip=False,
    )  # fmt: skip
