"""The picture of accuracy against time."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.analysis.cost.curves import FrontPart, MeanCurve
from hwp_bench.base.files import atomic_write
from hwp_bench.metrics import metric as metric_facts

#: Colours that people with any colour vision tell apart (Okabe and Ito, 2008).
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
#: Line styles, so that no curve depends on its colour.
STYLES = ("-", "--", "-.", ":")
#: Endings of the files that are written.
ENDINGS = ("png", "svg")


def draw_pareto(curves: Sequence[MeanCurve], front: Sequence[FrontPart], metric: str) -> Any:
    """Draw score against seconds, one curve a method, with the front behind them.

    Args:
        curves: the methods' mean curves.
        front: what `pareto_front` returned for them.
        metric: the metric of the scores.

    Returns:
        A matplotlib figure.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator

    facts = metric_facts(metric)
    figure = Figure(figsize=(7.2, 4.6), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    axes.set_xscale("log")
    by_label = {curve.label: curve for curve in curves}
    for index, part in enumerate(front):
        curve = by_label[part.label]
        inside = (curve.seconds >= part.start) & (curve.seconds <= part.stop)
        seconds = [part.start, *curve.seconds[inside], part.stop]
        # Where the leader falls back for a while, the front keeps the best score so far.
        best = np.maximum if facts.higher_is_better else np.minimum
        scores = best.accumulate([part.first_score, *curve.scores[inside], part.last_score])
        label = "Pareto front" if index == 0 else None
        axes.plot(seconds, scores, color="#F0C808", linewidth=9, alpha=0.55, label=label,
                  solid_capstyle="round", zorder=1)  # fmt: skip
    for index, curve in enumerate(curves):
        colour = COLOURS[index % len(COLOURS)]
        style = STYLES[(index // len(COLOURS) + index) % len(STYLES)]
        if curve.low is not None and curve.high is not None:
            axes.fill_between(
                curve.seconds, curve.low, curve.high, color=colour, alpha=0.1, linewidth=0, zorder=0
            )
        axes.plot(curve.seconds, curve.scores, style, color=colour, linewidth=1.8,
                  label=curve.label, zorder=3)  # fmt: skip
        axes.plot(curve.seconds[-1], curve.scores[-1], "o", color=colour, markersize=6, zorder=4)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(FuncFormatter(lambda *_: ""))
    axes.set_xlabel("Seconds of fitting (log scale)")
    unit = f" [{facts.unit}]" if facts.unit else ""
    better = "higher" if facts.higher_is_better else "lower"
    axes.set_ylabel(f"{facts.label}{unit}, validation frames ({better} is better)")
    if not facts.higher_is_better:
        axes.invert_yaxis()
    _limit(axes, curves)
    axes.grid(True, which="major", color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    banded = any(curve.low is not None for curve in curves)
    title = "Bands: 95 % interval over captures" if banded else None
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=9, title=title,
                  title_fontsize=8)  # fmt: skip
    return figure


def _limit(axes: Any, curves: Sequence[MeanCurve]) -> None:
    """Let the curves fill the picture: wide bands of few captures would press them flat."""
    scores = np.concatenate([curve.scores for curve in curves])
    span = max(float(np.ptp(scores)), 1e-9)
    bottom, top = float(scores.min()) - 0.35 * span, float(scores.max()) + 0.35 * span
    axes.set_ylim((top, bottom) if axes.yaxis_inverted() else (bottom, top))


def write_figure(folder: Path, name: str, figure: Any) -> list[Path]:
    """Write a figure as PNG and SVG; the same figure gives the same bytes.

    Args:
        folder: where to.
        name: of the files, without ending.
        figure: a matplotlib figure.
    """
    import matplotlib

    written = []
    with matplotlib.rc_context({"svg.hashsalt": "hwp-bench", "svg.fonttype": "path"}):
        for ending in ENDINGS:
            stream = io.BytesIO()
            metadata = {"Date": None} if ending == "svg" else {"Software": None}
            figure.savefig(stream, format=ending, metadata=metadata)
            written.append(atomic_write(folder / f"{name}.{ending}", stream.getvalue()))
    return written
