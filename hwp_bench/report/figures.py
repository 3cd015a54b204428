"""Every figure by matplotlib, as a file or in a page: score over seconds, bars by perturbation.

Figures are drawn in the colours of `PALETTE`. In a page each of them is a variable of the style
sheet, so that a figure follows the light and the dark scheme.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hwp_bench.analysis.cost.analysis import CostAnalysis
from hwp_bench.analysis.cost.curves import FrontPart, MeanCurve
from hwp_bench.analysis.statistics.bootstrap import Estimate
from hwp_bench.base.files import atomic_write
from hwp_bench.base.tables import write_tables
from hwp_bench.metrics import metric as metric_facts

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
_BANDS = 4
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

    Where there are many methods, only those of the front have their bands.

    Args:
        curves: the methods' mean curves, at least one.
        front: what `pareto_front` returned for them.
        metric: the metric of the scores.
        order: number of each method by label, for its colour; None numbers them here and adds
            a legend.
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
        leading = {part.label for part in front}
        for curve in curves:
            style = series_style(places[curve.label])
            banded = len(curves) <= _BANDS or curve.label in leading
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
            banded = any(curve.low is not None for curve in curves)
            title = "Bands: 95 % interval over captures" if banded else None
            figure.legend(
                loc="lower left", frameon=False, fontsize=9, title=title, title_fontsize=9,
                alignment="left", handlelength=4,
            )  # fmt: skip
    return figure


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


@dataclass(frozen=True)
class Bar:
    """One method in one group of bars."""

    #: Number of the method, for its colour.
    method: int
    #: Its mean and interval.
    estimate: Estimate


def draw_bars(groups: Mapping[str, Sequence[Bar]], metric: str) -> Figure:
    """Draw one group of bars a perturbation, each with its 95 % interval.

    Bars begin at zero; an interval that leaves the figure is cut there, and has no end mark.

    Args:
        groups: by heading; at least one bar in all.
        metric: of the estimates.
    """
    digits = metric_facts(metric).digits
    values = [bar.estimate.value for bars in groups.values() for bar in bars]
    ends = [bar.estimate.high for bars in groups.values() for bar in bars]
    top = max([*values, 1e-9])
    high = min(max([top, *(end for end in ends if end is not None)]), 1.35 * top)
    height = 24.0 * len(groups) + 14.0 * len(values)
    with figure_style():
        figure = new_figure(height)
        axes = add_axes(figure, 8, 0, WIDTH - 70, height)
        axes.spines["bottom"].set_visible(False)
        axes.set(xlim=(0, high), ylim=(height, 0))
        place = 0.0
        for title, bars in groups.items():
            axes.text(0, place + 14, title, size=12, weight="bold")
            place += 20
            for bar in bars:
                _draw_bar(axes, bar, place + 5.5, high)
                text = f"{bar.estimate.value:.{digits}f}"
                axes.annotate(
                    text, (1, place + 5.5), (60, 0), textcoords="offset points", ha="right",
                    xycoords=axes.get_yaxis_transform(), va="center", color=PALETTE["faint"],
                )  # fmt: skip
                place += 14
            place += 4
    return figure


def _draw_bar(axes: Axes, bar: Bar, middle: float, high: float) -> None:
    estimate = bar.estimate
    shown = float(np.clip(estimate.value, 0.002 * high, high))
    color = PALETTE[f"s{bar.method % SERIES}"]
    axes.barh(middle, shown, height=11, color=color, gid=f"{MARK}bar")
    if estimate.low is not None and estimate.high is not None:
        reach = np.clip([estimate.low, estimate.high], 0, high)
        axes.hlines(middle, *reach, color=PALETTE["ink"], linewidth=1.4, gid=f"{MARK}whisker")
        marks = [end for end in (estimate.low, estimate.high) if 0 <= end <= high]
        axes.vlines(marks, middle - 4, middle + 4, color=PALETTE["ink"], linewidth=1.4)


def write_cost(folder: Path, analysis: CostAnalysis) -> list[Path]:
    """Write the tables of a cost analysis in every format, and its figure; returns the latter."""
    write_tables(folder / "tables", analysis.tables)
    figure = draw_pareto(analysis.curves, analysis.front, analysis.metric)
    return write_figure(folder, "pareto", figure)


def write_figure(folder: Path, name: str, figure: Figure) -> list[Path]:
    """Write a figure on white as PNG and SVG; the same figure gives the same bytes.

    Args:
        folder: where to.
        name: of the files, without ending.
        figure: the figure.
    """
    written = []
    with figure_style(**{"svg.fonttype": "path"}):
        for ending in ENDINGS:
            stream = io.BytesIO()
            metadata = {"Date": None} if ending == "svg" else {"Software": None}
            figure.savefig(stream, format=ending, dpi=DPI, facecolor="white", metadata=metadata)
            written.append(atomic_write(folder / f"{name}.{ending}", stream.getvalue()))
    return written
