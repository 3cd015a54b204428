"""Every figure by matplotlib, as a file or in a page: curves, bars, strips of captures.

Figures are drawn in the colours of `PALETTE`. In a page each of them is a variable of the style
sheet, so that a figure follows the light and the dark scheme.
"""

from __future__ import annotations

import hashlib
import io
import re
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from hwp_bench.analysis.bootstrap import Estimate, bootstrap_mean
from hwp_bench.analysis.cost import CostAnalysis
from hwp_bench.analysis.curves import LEAST_CAPTURES, FrontPart, MeanCurve
from hwp_bench.analysis.pairing import MethodRuns, scopes
from hwp_bench.base.files import atomic_write
from hwp_bench.base.tables import write_tables
from hwp_bench.capture.schema import CaptureInfo
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.report.sources import TemporalWeights
from hwp_bench.results import CaptureResult
from hwp_bench.taxonomy import MAX_SEVERITY, PERTURBATIONS, perturbation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


#: Colours of figures: those of the style sheet's light scheme, by the name of its variable.
PALETTE: Mapping[str, str] = {
    "ink": "#1b1f24",
    "faint": "#5b6570",
    "line": "#d5dbe1",
    "shade": "#f3f5f7",
    "front": "#f3d34a",
    "severity": "#c2410c",
    "test": "#0b5cad",
    "s0": "#0072b2",
    "s1": "#c44e00",
    "s2": "#00795a",
    "s3": "#b3478a",
    "s4": "#8a6200",
    "s5": "#3a7fb0",
    "s6": "#5b5b5b",
    "s7": "#7a3fb5",
}
#: Number of series that the palette has a colour for.
SERIES = 8
#: Dashes of the series, in turn, so that no curve depends on its colour.
DASHES: Sequence[Any] = ("-", (0, (7, 3)), (0, (2, 3)), (0, (9, 3, 2, 3)))
#: Most methods whose bands are all drawn: more of them hide each other.
_BANDS = 2
#: Width of every figure, px; a page scales it.
WIDTH = 460.0
#: Marks an artist whose name becomes a class of the element in a page.
MARK = "class-"
#: Formats of the files that are written, and their resolution.
ENDINGS, DPI = ("png", "svg"), 180

_STYLE: dict[str, Any] = {
    "font.size": 11.0,
    "text.color": PALETTE["ink"],
    "lines.scale_dashes": False,
    "lines.solid_joinstyle": "round",
    # Names of methods may hold dollar signs, which are not formulas.
    "text.parse_math": False,
    "svg.hashsalt": "hwp-bench",
}


@contextmanager
def figure_style(**more: Any) -> Iterator[None]:
    """Set the style that figures are made and written in."""
    import matplotlib

    settings: Any = {**_STYLE, **more}
    with matplotlib.rc_context(settings), warnings.catch_warnings():
        # A page has its own fonts; the letters that matplotlib's font lacks do not matter.
        warnings.filterwarnings("ignore", message=r"Glyph .* missing")
        yield


def new_figure(height: float) -> Figure:
    """Return an empty figure of `WIDTH` by `height` px."""
    from matplotlib.figure import Figure

    return Figure(figsize=(WIDTH / 72, height / 72), dpi=72, facecolor="none")


def add_axes(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Return axes with a line below and no ticks at a place, px from the figure's upper left."""
    from matplotlib.ticker import NullLocator

    whole = figure.get_figheight() * 72
    axes = figure.add_axes(
        (left / WIDTH, 1 - (top + height) / whole, width / WIDTH, height / whole), facecolor="none"
    )
    axes.spines[["left", "top", "right"]].set_visible(False)
    axes.spines["bottom"].set(color=PALETTE["faint"], linewidth=1)
    axes.tick_params(
        length=0, which="both", labelcolor=PALETTE["faint"], labelleft=False, labelbottom=False
    )
    axes.xaxis.set_major_locator(NullLocator())
    axes.yaxis.set_major_locator(NullLocator())
    axes.margins(0)
    return axes


def scale_up(axes: Axes, low: float, high: float, count: int = 5) -> None:
    """Give axes the range [low, high], round numbers on the left, and lines through them."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    axes.set_ylim(low, high)
    axes.yaxis.set_major_locator(MaxNLocator(count, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.5g}"))
    axes.tick_params(axis="y", labelleft=True, pad=5)
    axes.grid(axis="y", color=PALETTE["line"], linewidth=0.7)
    axes.set_axisbelow(True)


def heading(axes: Axes, text: str, above: float = 5.0) -> None:
    """Put a bold line over axes, a few px above them."""
    axes.annotate(
        text, (0, 1), (0, above), xycoords="axes fraction", textcoords="offset points",
        size=12, weight="bold", annotation_clip=False,
    )  # fmt: skip


def series_style(index: int) -> dict[str, Any]:
    """Return colour and dashes of a method's curve, different ones for the first 32 methods."""
    color, dashes = _series(index)
    return {"color": PALETTE[f"s{color}"], "linestyle": DASHES[dashes], "linewidth": 2}


def series_classes(index: int) -> str:
    """Return the classes of the page's style sheet that look like `series_style`."""
    color, dashes = _series(index)
    return f"s{color} dash{dashes}"


def _series(index: int) -> tuple[int, int]:
    """Numbers of a method's colour and dashes."""
    return index % SERIES, (index + index // SERIES) % len(DASHES)


def draw_pareto(
    curves: Sequence[MeanCurve],
    front: Sequence[FrontPart],
    metric: str,
    order: Mapping[str, int] | None = None,
) -> Figure:
    """Draw mean validation score over the seconds of fitting, the front behind the curves.

    Where there are many methods, only the ends of the front have their bands.
    """
    facts = metric_facts(metric)
    places = order or {curve.label: index for index, curve in enumerate(curves)}
    names = [] if order else [curve.label for curve in curves]
    with figure_style():
        figure = new_figure(268 + (16 * len(names) + 34 if names else 0))
        axes = add_axes(figure, 44, 18, WIDTH - 62, 214)
        start = min(float(curve.seconds[0]) for curve in curves)
        stop = max(max(float(curve.seconds[-1]) for curve in curves), 1.1 * start)
        # Wide bands of few captures would press the curves flat, so the curves choose the range.
        scores = np.concatenate([curve.scores for curve in curves])
        span = max(float(np.ptp(scores)), 1e-6)
        low, high = float(scores.min()) - 0.3 * span, float(scores.max()) + 0.2 * span
        up = (low, high) if facts.higher_is_better else (high, low)
        _seconds_axis(axes, start, stop)
        scale_up(axes, *up)
        _draw_front(axes, {curve.label: curve for curve in curves}, front, facts.higher_is_better)
        ends = {part.label for part in (*front[:1], *front[-1:])}
        for curve in curves:
            style = series_style(places[curve.label])
            banded = len(curves) <= _BANDS or curve.label in ends
            if banded and curve.low is not None and curve.high is not None:
                bottom, top = np.clip(curve.low, low, high), np.clip(curve.high, low, high)
                axes.fill_between(
                    curve.seconds, bottom, top, color=style["color"], alpha=0.13, linewidth=0,
                    gid=f"{MARK}band",
                )  # fmt: skip
            axes.plot(curve.seconds, curve.scores, label=curve.label, **style)
            end = curve.seconds[-1], curve.scores[-1]
            axes.plot(*end, "o", color=style["color"], markersize=8, clip_on=False)
        unit = f" [{facts.unit}]" if facts.unit else ""
        better = "" if facts.higher_is_better else ", lower is better"
        heading(axes, f"{facts.label}{unit}, validation frames{better}")
        if names:
            title = bands_text(curves)
            title = title[0].upper() + title[1:]
            figure.legend(
                loc="lower left", frameon=False, fontsize=9, title=title, title_fontsize=9,
                alignment="left", handlelength=4,
            )  # fmt: skip
    return figure


def bands_text(curves: Sequence[MeanCurve]) -> str:
    """Say what the bands of `draw_pareto` are, or why there are none."""
    if all(curve.low is None for curve in curves):
        return f"no intervals: of fewer than {LEAST_CAPTURES} captures they say nothing"
    some = " of the first and the last method on the front" if len(curves) > _BANDS else ""
    return f"shaded bands are 95 % intervals over captures{some}"


def _seconds_axis(axes: Axes, start: float, stop: float) -> None:
    """Lay out seconds on a log scale: 1, 2, 5 and so on; the ends where few of them are inside."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullLocator

    axes.set_xscale("log")
    axes.set_xlim(start, stop)
    found = LogLocator(subs=(1.0, 2.0, 5.0)).tick_values(start, stop)
    inside = [float(value) for value in found if start <= value <= stop]
    if len(inside) > 7:
        inside = [value for value in inside if f"{value:e}".startswith("1")]
    axes.xaxis.set_major_locator(FixedLocator(inside if len(inside) > 1 else [start, stop]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    axes.tick_params(axis="x", length=4, color=PALETTE["faint"], labelbottom=True)
    text = "seconds of fitting (log)"
    axes.set_xlabel(text, loc="right", size=12, weight="bold", color=PALETTE["ink"])


def _draw_front(
    axes: Axes, curves: Mapping[str, MeanCurve], front: Sequence[FrontPart], higher: bool
) -> None:
    for index, part in enumerate(front):
        curve = curves[part.label]
        inside = (curve.seconds >= part.start) & (curve.seconds <= part.stop)
        seconds = [part.start, *curve.seconds[inside], part.stop]
        # Where the leading method falls back for a while, the front keeps the best score so far.
        best = np.maximum if higher else np.minimum
        scores = best.accumulate([part.first_score, *curve.scores[inside], part.last_score])
        axes.plot(
            seconds, scores, color=PALETTE["front"], linewidth=9, solid_capstyle="round",
            label="Pareto front" if index == 0 else None, gid=f"{MARK}front",
        )  # fmt: skip


def bars_by_perturbation(runs: Sequence[MethodRuns], metric: str) -> Markup | None:
    """Draw the mean of each method and perturbation; None where no capture has one."""
    groups = {}
    for name, weights in scopes(runs[0].first).items():
        if name in PERTURBATIONS:
            samples = [[run.values(c, metric, sorted(run.seeds)) for c in weights] for run in runs]
            groups[perturbation(name).heading] = [
                bootstrap_mean(own, list(weights.values()), resamples=2000) for own in samples
            ]
    if not groups:
        return None
    title = f"{metric_facts(metric).label} by perturbation with 95 % intervals"
    return inline_svg(draw_bars(groups, metric), title)


def draw_bars(groups: Mapping[str, Sequence[Estimate]], metric: str) -> Figure:
    """Draw one group of bars a perturbation, one a method, each with its 95 % interval.

    Bars begin at zero; an interval that leaves the figure is cut there, and has no end mark.
    """
    digits = metric_facts(metric).digits
    every = [estimate for bars in groups.values() for estimate in bars]
    top = max([*(estimate.value for estimate in every), 1e-9])
    high = min(max([top, *(one.high for one in every if one.high is not None)]), 1.35 * top)
    height = 24.0 * len(groups) + 14.0 * len(every)
    with figure_style():
        figure = new_figure(height)
        axes = add_axes(figure, 8, 0, WIDTH - 70, height)
        axes.spines["bottom"].set_visible(False)
        axes.set(xlim=(0, high), ylim=(height, 0))
        place = 0.0
        for title, bars in groups.items():
            axes.text(0, place + 14, title, size=12, weight="bold")
            place += 20
            for number, estimate in enumerate(bars):
                _draw_bar(axes, estimate, PALETTE[f"s{number % SERIES}"], place + 5.5, high)
                text = f"{estimate.value:.{digits}f}"
                axes.annotate(
                    text, (1, place + 5.5), (60, 0), textcoords="offset points", ha="right",
                    xycoords=axes.get_yaxis_transform(), va="center", color=PALETTE["faint"],
                )  # fmt: skip
                place += 14
            place += 4
    return figure


def _draw_bar(axes: Axes, estimate: Estimate, color: str, middle: float, high: float) -> None:
    shown = float(np.clip(estimate.value, 0.002 * high, high))
    axes.barh(middle, shown, height=11, color=color, gid=f"{MARK}bar")
    if estimate.low is not None and estimate.high is not None:
        reach = np.clip([estimate.low, estimate.high], 0, high)
        axes.hlines(middle, *reach, color=PALETTE["ink"], linewidth=1.4, gid=f"{MARK}whisker")
        marks = [end for end in (estimate.low, estimate.high) if 0 <= end <= high]
        axes.vlines(marks, middle - 4, middle + 4, color=PALETTE["ink"], linewidth=1.4)


def draw_leads(title: str, leads: Sequence[tuple[str, Estimate]], metric: str) -> Figure:
    """Draw by how much a method is ahead of each other one: a bar, its 95 % interval, a number."""
    from matplotlib.ticker import MaxNLocator

    facts, height = metric_facts(metric), 19.0 * len(leads)
    with figure_style():
        figure = new_figure(height + 46)
        axes = add_axes(figure, 145, 22, WIDTH - 195, height)
        axes.set_ylim(len(leads), 0)
        axes.margins(x=0.03)
        axes.axvline(0.0, color=PALETTE["ink"], linewidth=1)
        for place, (label, one) in enumerate(leads):
            middle, surely = place + 0.5, False
            if one.low is not None and one.high is not None:
                surely = not one.low <= 0.0 <= one.high
                axes.hlines(middle, one.low, one.high, color=PALETTE["ink"], zorder=3)
            color, alpha = PALETTE["s0" if one.value > 0 else "s1"], 1.0 if surely else 0.4
            axes.barh(middle, one.value, height=0.6, color=color, alpha=alpha)
            number = f"{one.value:+.{facts.digits}f}"
            for text, at, side in ((label, -0.02, "right"), (number, 1.02, "left")):
                line = axes.get_yaxis_transform()
                axes.text(at, middle, text, ha=side, va="center", transform=line)
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        axes.tick_params(axis="x", labelbottom=True, pad=4)
        axes.grid(axis="x", color=PALETTE["line"], linewidth=0.7)
        axes.set_axisbelow(True)
        unit = f" [{facts.unit}]" if facts.unit else ""
        heading(axes, f"{title} ahead in {facts.label}{unit}")
    return figure


def write_cost(folder: Path, analysis: CostAnalysis) -> list[Path]:
    """Write the tables of a cost analysis in every format, and its figure; returns the latter."""
    write_tables(folder / "tables", analysis.tables)
    figure = draw_pareto(analysis.curves, analysis.front, analysis.metric)
    return write_figure(folder, "pareto", figure)


def write_figure(folder: Path, name: str, figure: Figure) -> list[Path]:
    """Write a figure on white as PNG and SVG; the same figure gives the same bytes."""
    return [
        atomic_write(folder / f"{name}.{ending}", figure_file(figure, ending)) for ending in ENDINGS
    ]


def figure_file(figure: Figure, ending: str) -> bytes:
    """Return the content of a figure's file, on white, which a dark page shows too."""
    stream = io.BytesIO()
    metadata = {"Date": None} if ending == "svg" else {"Software": None}
    with figure_style(**{"svg.fonttype": "path"}):
        figure.savefig(stream, format=ending, dpi=DPI, facecolor="white", metadata=metadata)
    return stream.getvalue()


def inline_svg(figure: Figure, title: str) -> Markup:
    """Return a figure as an SVG element for a page: words stay words, colours are variables."""
    stream = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with figure_style(**{"svg.fonttype": "none"}):
        figure.savefig(stream, format="svg", metadata=nothing)
    text = stream.getvalue()
    drawn = ET.fromstring(text)
    # Two figures of one page must not share the names of their markers.
    own = "f" + hashlib.sha256(f"{title}{text}".encode()).hexdigest()[:10] + "-"
    box = drawn.attrib["viewBox"]
    # matplotlib states these two in a style element, which would rule the whole page.
    style = "stroke-linejoin:round;stroke-linecap:butt"
    attributes = {"viewBox": box, "role": "img", "aria-label": title, "class": "plot"}
    root = ET.Element("svg", {**attributes, "style": style})
    ET.SubElement(root, "title").text = title
    for child in drawn:
        _take_over(root, child, own)
    return Markup(ET.tostring(root, encoding="unicode"))


def _take_over(parent: ET.Element, drawn: ET.Element, own: str) -> None:
    """Copy an element without namespaces, clipping and names that nothing refers to."""
    tag = drawn.tag.rpartition("}")[2]
    if tag in ("style", "clipPath", "metadata"):
        return
    made = ET.SubElement(parent, tag)
    for key, value in drawn.attrib.items():
        name = key.rpartition("}")[2]
        if name == "id":
            if value.startswith(MARK):
                made.set("class", value.removeprefix(MARK))
            elif tag != "g":
                made.set("id", own + value)
        elif name == "href":
            made.set("href", "#" + own + value.removeprefix("#"))
        elif name == "style":
            made.set("style", _page_style(value))
        elif name != "clip-path" and not value.startswith("rotate(-0 "):
            short = re.sub(r"-?\d+\.\d+", lambda found: f"{float(found[0]):.2f}", value)
            made.set(name, " ".join(short.split()))
    if tag == "text":
        made.text = drawn.text
    for child in drawn:
        _take_over(made, child, own)
    if tag in ("defs", "g") and not len(made):
        parent.remove(made)


def _page_style(style: str) -> str:
    """Return a style with the page's own font, and its colours as variables."""
    parts = [part for part in style.split("; ") if not part.startswith("font-family")]
    variables = {color: f"var(--{name})" for name, color in PALETTE.items()}
    return re.sub(r"#[0-9a-f]{6}", lambda found: variables.get(found[0], found[0]), ";".join(parts))


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
    """Draw the strip of one capture."""
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
