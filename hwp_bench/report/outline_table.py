"""The table of how large methods draw the hand, which the headline does not see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean

from hwp_bench.analysis.outline import OutlineScores, outline_scores
from hwp_bench.base.console import track
from hwp_bench.base.errors import UsageError
from hwp_bench.base.images import read_rgb
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.capture import Capture
from hwp_bench.report.evaluation_tables import labels
from hwp_bench.report.sources import ResultsSource, stored_predictions

_NOTES = (
    "Means over captures of the means over test frames. Outside are pixels that the hand does not "
    "touch; lit ones of them, as a share of the scored pixels, are drawn outside.",
    "With the outside: the error of these pixels, which should be black, is added. If spread: the "
    "headline's PSNR if the drawn hand went on outwards in its nearest colours.",
    "A hand behind a sleeve or an object counts as drawn outside, for every method alike.",
)


def outline_table(sources: Sequence[ResultsSource], captures: Mapping[str, Capture]) -> Table:
    """Return one row a method: PSNR, what is drawn outside, and PSNR with it and with more of it.

    Frames without a sound prediction are left out, and captures that are not at hand for every
    method.

    Args:
        sources: evaluations with their predictions.
        captures: by digest.

    Raises:
        UsageError: no capture, or not every method's predictions of it, is at hand.
    """
    found: list[list[OutlineScores]] = [[] for _ in sources]
    for digest, capture in track(captures.items(), "Outlines", len(captures)):
        means = _means(sources, digest, capture)
        if means:
            for scores, mean in zip(found, means, strict=True):
                scores.append(mean)
    if not found or not found[0]:
        raise UsageError(
            "none of these captures is at hand with the predictions of every method",
            field="--captures",
            remedy="Name the capture folders, and results folders that hold predictions.",
        )
    columns = (
        Column("Method"),
        Column("PSNR [dB]", 2, True),
        Column("Drawn outside [%]", 1, False),
        Column("With the outside [dB]", 2, True),
        Column("If spread [dB]", 2),
    )
    rows: list[tuple[Cell, ...]] = []
    titles = labels([source.results for source in sources])
    for title, scores in zip(titles, found, strict=True):
        mean = _mean(scores)
        outside = 100.0 * mean.drawn_outside
        rows.append((title, mean.psnr, outside, mean.psnr_with_outside, mean.psnr_spread))
    return Table("By outline", columns, tuple(rows), _NOTES)


def _means(sources: Sequence[ResultsSource], digest: str, capture: Capture) -> list[OutlineScores]:
    """Each method's means over the test frames of a capture; empty where one has none to score."""
    runs = [
        {
            frame: path
            for item in source.on(digest)
            for frame, path in stored_predictions(source, item).items()
        }
        for source in sources
    ]
    if not all(runs):
        return []
    scores: list[list[OutlineScores]] = [[] for _ in sources]
    # Each frame is read once for all methods.
    for frame in sorted({frame for files in runs for frame in files}):
        target, (mask, exact) = capture.frame(frame), capture.scoring_mask(frame)
        for files, mine in zip(runs, scores, strict=True):
            if frame not in files:
                continue
            prediction = read_rgb(files[frame], capture.size)
            one = outline_scores(prediction, target, mask, coverage=exact)
            if one is not None:
                mine.append(one)
    return [_mean(mine) for mine in scores] if all(scores) else []


def _mean(scores: Sequence[OutlineScores]) -> OutlineScores:
    return OutlineScores(
        psnr=fmean(one.psnr for one in scores),
        drawn_outside=fmean(one.drawn_outside for one in scores),
        psnr_with_outside=fmean(one.psnr_with_outside for one in scores),
        psnr_spread=fmean(one.psnr_spread for one in scores),
    )
