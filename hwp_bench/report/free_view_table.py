"""The table of novel views: scores of the free-view clips, with intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hwp_bench.analysis.statistics.bootstrap import bootstrap_mean
from hwp_bench.analysis.statistics.pairing import MethodRuns, group_runs
from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.report.evaluation_tables import score_column
from hwp_bench.results import FreeViewResult, Results
from hwp_bench.results.schema import add_isolation_note

#: Name of the table.
NAME = "free-view"
#: The metric with an interval, and those without, where all results have them.
MAIN, OTHERS = "psnr", ("ssim", "lpips_alex")
#: Heading of the rows over all captures.
ALL = "all"
#: Resamples of an interval.
_RESAMPLES = 2000


def free_view_tables(results: Sequence[Results]) -> dict[str, Table]:
    """Return the table by its name; empty where no result has scores of a clip."""
    scored = any(item.free_view for result in results for item in result.captures)
    return {NAME: add_isolation_note(free_view_table(results), results)} if scored else {}


def free_view_table(results: Sequence[Results]) -> Table:
    """Return one row a capture and method, and one a method over all captures.

    Seeds of a method are averaged. Failed frames are counted where there are any. `all` is the
    mean over the captures that every method has scores of, each of which counts the same.

    Args:
        results: evaluations; those without any scores of a clip are left out.

    Raises:
        UsageError: none has such scores, no capture is common to all, two results are of the same
            method and seed, or the clips of a capture differ.
        BadResult: a clip lists no frame, or frames without the main metric.
    """
    scored = [r for r in results if any(item.free_view for item in r.captures)]
    if not scored:
        raise UsageError(
            "no result has scores of a free-view clip",
            field="RESULTS",
            remedy="Evaluate again: `hwp-bench sim render --suite NAME` adds clips to captures.",
        )
    runs = group_runs(scored)
    found = {run.label: _of_run(run) for run in runs}
    _refuse_other_clips(found)
    common = [
        item.id
        for item in runs[0].first.captures
        if all(item.id in captures for captures in found.values())
    ]
    if not common:
        raise UsageError("no capture has a scored clip in every result", field="RESULTS")
    names = [name for name in OTHERS if all(_has(captures, name) for captures in found.values())]
    rows: list[tuple[Cell, ...]] = []
    breaks = []
    for title, captures in [*((one, [one]) for one in common), (ALL, common)]:
        if title == ALL and len(common) == 1:
            continue
        breaks.append(len(rows))
        for run in runs:
            clips = [found[run.label][capture] for capture in captures]
            failed = sum(f.failure is not None for own in clips for c in own for f in c.frames)
            test = _test(run, captures)
            rows.append((title, run.label, *_cells(clips, names), test, failed))
    main = score_column(MAIN)
    columns = (
        Column("Capture"),
        Column("Method"),
        main,
        Column("Low", main.digits, group=_INTERVAL),
        Column("High", main.digits, group=_INTERVAL),
        *(score_column(name) for name in names),
        Column(main.title, main.digits, group=_TEST),
        Column("Failed", 0),
    )
    if not any(row[-1] for row in rows):
        columns, rows = columns[:-1], [row[:-1] for row in rows]
    return Table("Novel views", columns, tuple(rows), _NOTES, breaks=tuple(breaks[1:]))


# Headings of the interval and of the score of test frames.
_INTERVAL, _TEST = "95 %", "Test"
_NOTES = (
    "The clean hand in unseen poses from cameras all around, with true parameters; "
    "Test: the mean over the test frames of the same captures.",
    "95 % intervals: bootstrap over captures, then seeds and frames (docs/statistics.md); a single "
    "capture's speak of further views of it.",
)


def _of_run(run: MethodRuns) -> dict[str, list[FreeViewResult]]:
    """The scored clips of a method by capture, one a seed; captures that all seeds have."""
    seeds = [run.seeds[seed] for seed in sorted(run.seeds)]
    tables = [_clips(result) for result in seeds]
    return {
        name: [table[name] for table in tables]
        for name in tables[0]
        if all(name in table for table in tables)
    }


def _clips(result: Results) -> dict[str, FreeViewResult]:
    found = {}
    for item in result.captures:
        if item.free_view is None:
            continue
        metrics = {frozenset(frame.scores) for frame in item.free_view.frames}
        if len(metrics) != 1 or MAIN not in next(iter(metrics)):
            raise BadResult(
                f"has frames without {MAIN}, or of different metrics, or none",
                where=item.id,
                field="free_view.frames",
            )
        found[item.id] = item.free_view
    return found


def _refuse_other_clips(found: Mapping[str, Mapping[str, Sequence[FreeViewResult]]]) -> None:
    seen: dict[str, tuple[str, list[int]]] = {}
    for captures in found.values():
        for name, clips in captures.items():
            for clip in clips:
                data = clip.digest, [frame.frame for frame in clip.frames]
                if seen.setdefault(name, data) != data:
                    raise UsageError(
                        "results on different free-view clips cannot stand in one table",
                        where=name,
                        remedy="Evaluate the methods on the same captures.",
                    )


def _has(captures: Mapping[str, Sequence[FreeViewResult]], metric: str) -> bool:
    return all(metric in clip.frames[0].scores for clips in captures.values() for clip in clips)


def _values(clips: Sequence[FreeViewResult], metric: str) -> np.ndarray:
    """(S, F) scores of one capture."""
    return np.array([[frame.scores[metric] for frame in clip.frames] for clip in clips])


def _cells(captures: Sequence[Sequence[FreeViewResult]], names: Sequence[str]) -> tuple[Cell, ...]:
    samples = [_values(clips, MAIN) for clips in captures]
    estimate = bootstrap_mean(samples, resamples=_RESAMPLES)
    others = [float(np.mean([_values(clips, name).mean() for clips in captures])) for name in names]
    return (estimate.value, estimate.low, estimate.high, *others)


def _test(run: MethodRuns, captures: Sequence[str]) -> float:
    """Mean over captures of the mean over seeds and test frames."""
    seeds = sorted(run.seeds)
    return float(np.mean([run.values(name, MAIN, seeds).mean() for name in captures]))
