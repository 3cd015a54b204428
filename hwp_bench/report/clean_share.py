"""Scores over the share of clean training frames: a table, and a figure with intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.analysis.bootstrap import Estimate, bootstrap_mean
from hwp_bench.analysis.columns import Filled, block_breaks, score_column, table_of
from hwp_bench.analysis.pairing import (
    group_runs,
    refuse_other_frames,
    refuse_other_scoring,
    same_but_seed,
)
from hwp_bench.base.errors import UsageError
from hwp_bench.base.tables import Column, Table
from hwp_bench.capture.schema import CaptureInfo
from hwp_bench.capture.splits import contiguous_split
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
    write_figure,
)
from hwp_bench.report.tables import HEADLINE, labels
from hwp_bench.results import CaptureResult, Results

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Resamples of an interval; more change no digit that is shown.
_RESAMPLES = 4000
# Distance of two methods' marks at one share, in percent of clean frames.
_ASIDE = 0.5


@dataclass(frozen=True)
class ShareScore:
    """The score of one method at one share of clean training frames."""

    #: Name of the method, unique in a table.
    label: str
    #: Share of clean training frames, 0 to 1.
    share: float
    #: Mean over captures of means over seeds and test frames.
    score: Estimate
    #: The same of its difference from the first method, over the captures of which both have the
    #: same seeds; None for the first, and where there is no such capture.
    behind: Estimate | None
    #: Seeds of which the score is; the fewest of a capture.
    seeds: int


def clean_share_of(info: CaptureInfo) -> float | None:
    """Share of clean training frames of a capture, 0 to 1; None where severities are unknown.

    A capture that was rendered at a share says it; of another one the training frames are counted
    in which no perturbation has a severity, to a whole percent.
    """
    said = info.source.get("clean_share")
    if isinstance(said, (int, float)):
        return float(said)
    if any(values is None for values in info.perturbations.values()):
        return None
    train = contiguous_split(info.id, info.frame_count).train
    worst = [max(frame) for frame in zip(*info.perturbations.values(), strict=True)]
    return round(float(np.mean([not worst[k] for k in train])), 2) if worst else 1.0


def scores_by_share(
    results: Sequence[Results], captures: Mapping[str, CaptureInfo], metric: str
) -> list[ShareScore]:
    """Return the score of every method at every share, by share, methods as they were given.

    Suites do not matter: a method's results on several suites are one curve.

    Args:
        captures: what captures say of themselves, by digest (`report.sources.find_captures`).

    Raises:
        UsageError: the share of none of these captures is known, or results cannot be paired.
    """
    _refuse_unlike(results)
    shares = {digest: clean_share_of(info) for digest, info in captures.items()}
    firsts: dict[str, Results] = {}
    curves: dict[str, dict[float, dict[str, np.ndarray]]] = {}
    seeds: dict[tuple[str, str], list[int]] = {}
    for run in group_runs([_of_its_captures(result) for result in results]):
        key = same_but_seed(replace(run.first, suite=""))
        firsts.setdefault(key, run.first)
        for capture in run.first.captures:
            share = shares.get(capture.digest)
            if share is None:
                continue
            own = sorted(run.seeds)
            seeds[key, capture.digest] = own
            values = run.values(capture.id, metric, own)
            curves.setdefault(key, {}).setdefault(share, {})[capture.digest] = values
    if not curves:
        raise UsageError(
            "the share of clean training frames of none of these captures is known",
            field="--capture",
            remedy="Name the capture folders, or render the suite on this machine.",
        )
    titles = dict(zip(firsts, labels([*firsts.values()], seeds=False), strict=True))
    first = next(iter(curves))

    def behind(key: str, share: float) -> Estimate | None:
        """The paired difference from the first over the captures of which both have these seeds."""
        reference = {} if key == first else curves[first].get(share, {})
        pairs = [
            values - reference[digest]
            for digest, values in curves[key][share].items()
            if digest in reference and seeds[key, digest] == seeds[first, digest]
        ]
        return bootstrap_mean(pairs, resamples=_RESAMPLES) if pairs else None

    found = [
        ShareScore(
            titles[key],
            share,
            bootstrap_mean([*values.values()], resamples=_RESAMPLES),
            behind(key, share),
            min(len(seeds[key, digest]) for digest in values),
        )
        for key, curve in curves.items()
        for share, values in curve.items()
    ]
    return sorted(found, key=lambda one: one.share)


def _refuse_unlike(results: Sequence[Results]) -> None:
    """Refuse what `compare` refuses, but that results may be of other captures."""
    first = results[0]
    seen: dict[str, tuple[str, CaptureResult]] = {}
    for result in results:
        refuse_other_scoring(f"{first.method.title} and {result.method.title}", first, result)
        for capture in result.captures:
            title, twin = seen.setdefault(capture.digest, (result.method.title, capture))
            refuse_other_frames(f"{title} and {result.method.title}", twin, capture)


def _of_its_captures(result: Results) -> Results:
    """A result whose captures are named by their digests, because their names are not unique."""
    digests = sorted(capture.digest for capture in result.captures)
    return replace(result, suite=" ".join(digests))


def clean_share_table(
    results: Sequence[Results], captures: Mapping[str, CaptureInfo], metric: str = HEADLINE[0]
) -> Table:
    """Return one row per share and method: score and difference from the first, with intervals."""
    found = scores_by_share(results, captures, metric)
    digits = metric_facts(metric).digits
    score = score_column(metric)
    behind = [one.behind for one in found]
    columns: list[Filled] = [
        (Column("Clean [%]", 0), [100.0 * one.share for one in found]),
        (Column("Method"), [one.label for one in found]),
        (replace(score, group=""), [one.score.value for one in found]),
        (Column("Low", digits, group="95 %"), [one.score.low for one in found]),
        (Column("High", digits, group="95 %"), [one.score.high for one in found]),
        (
            Column("Difference", digits, group="Less the first"),
            [None if b is None else b.value for b in behind],
        ),
        (
            Column("Low", digits, group="Less the first"),
            [None if b is None else b.low for b in behind],
        ),
        (
            Column("High", digits, group="Less the first"),
            [None if b is None else b.high for b in behind],
        ),
        (Column("Captures", 0), [one.score.captures for one in found]),
        (Column("Seeds", 0), [one.seeds for one in found]),
    ]
    note = (
        "Clean: share of the training frames that nothing perturbs; the test frames are clean. "
        "Means over captures, with 95 % intervals over captures, seeds and frames."
    )
    breaks = block_breaks([one.share for one in found])
    return table_of("By share of clean training frames", columns, [note], breaks=breaks)


def draw_clean_share(found: Sequence[ShareScore], metric: str) -> Figure:
    """Draw the score of every method over the share of clean frames, with 95 % intervals.

    Intervals of several methods at one share stand next to each other. One that leaves the figure
    is cut there, so that wide intervals of few captures do not press the curves flat.
    """
    from matplotlib.ticker import FixedLocator, FuncFormatter

    facts = metric_facts(metric)
    names = list(dict.fromkeys(one.label for one in found))
    shares = sorted({100.0 * one.share for one in found})
    values = [one.score.value for one in found]
    span = max(float(np.ptp(values)), 1e-6)
    low, high = min(values) - 0.35 * span, max(values) + 0.35 * span
    with figure_style():
        figure = new_figure(296 + 16 * len(names) + 34)
        axes = add_axes(figure, 44, 18, WIDTH - 62, 240)
        axes.set_xlim(shares[0] - 4.0, shares[-1] + 4.0)
        scale_up(axes, *((low, high) if facts.higher_is_better else (high, low)))
        for number, name in enumerate(names):
            style = series_style(number)
            own = [one for one in found if one.label == name]
            places = [100.0 * one.share + _ASIDE * (number - len(names) / 2) for one in own]
            axes.plot(places, [one.score.value for one in own], label=name, **style)
            axes.plot(
                places, [one.score.value for one in own], "o", color=style["color"], markersize=5
            )
            for place, one in zip(places, own, strict=True):
                if one.score.low is not None and one.score.high is not None:
                    ends = np.clip([one.score.low, one.score.high], low, high)
                    axes.vlines(
                        place, *ends, color=style["color"], linewidth=1, alpha=0.5,
                        gid=f"{MARK}whisker",
                    )  # fmt: skip
        axes.xaxis.set_major_locator(FixedLocator(shares))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g} %"))
        axes.tick_params(axis="x", length=4, color=PALETTE["faint"], labelbottom=True)
        text = "clean training frames"
        axes.set_xlabel(text, loc="right", size=12, weight="bold", color=PALETTE["ink"])
        unit = f" [{facts.unit}]" if facts.unit else ""
        better = "" if facts.higher_is_better else ", lower is better"
        heading(axes, f"{facts.label}{unit}, test frames{better}")
        figure.legend(
            loc="lower left", frameon=False, fontsize=9, alignment="left", handlelength=4,
            title="Lines: 95 % intervals over captures", title_fontsize=9,
        )  # fmt: skip
    return figure


def write_clean_share(
    folder: Path,
    results: Sequence[Results],
    captures: Mapping[str, CaptureInfo],
    metric: str = HEADLINE[0],
) -> list[Path]:
    """Write the figure into a folder, `clean-share.png` and `.svg`; returns both."""
    figure = draw_clean_share(scores_by_share(results, captures, metric), metric)
    return write_figure(folder, "clean-share", figure)
