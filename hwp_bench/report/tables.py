"""Tables of evaluations: overall, by capture and perturbation, novel views, means over seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hwp_bench.analysis.bootstrap import bootstrap_mean
from hwp_bench.analysis.columns import Filled, block_breaks, score_column, table_of, with_columns
from hwp_bench.analysis.pairing import MethodRuns, group_runs
from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.metrics import HWP_V1, METRICS, Protocol
from hwp_bench.metrics.score import Aggregate, Scores, Summary, aggregate
from hwp_bench.results import CaptureResult, FreeViewResult, Results
from hwp_bench.results.schema import (
    add_isolation_note,
    add_validation_note,
    budget_text,
    differing_makers,
    differing_settings,
    per_second,
    score_rows,
    shown_files,
)
from hwp_bench.suites.suite import lost_clips
from hwp_bench.taxonomy import PERTURBATIONS, perturbation

#: Metrics of the headline tables, where an evaluation has them.
HEADLINE = ("psnr", "ssim", "oriented_distance", "flip", "lpips_alex", "lpips_vgg")
#: Metrics of the tables in the paper's protocol.
PAPER = ("paper_psnr", "paper_ssim", "paper_lpips")
#: Heading of the mean over perturbations, and of the mean in which every frame counts the same.
MACRO, ALL_FRAMES = "Macro", "All frames"

_PAPER_NOTE = (
    "Protocol paper-wildghand: the released evaluator's settings with the data set's mask; "
    "these numbers are not comparable with the headline's."
)


def all_tables(results: Sequence[Results]) -> dict[str, Table]:
    """Return every table of one or several evaluations, by name.

    `overall` (single, interacting, macro mean, with cost), `captures`, `perturbations`,
    `details` (every metric of protocol hwp-v1), `micro` (every frame counts the same) and
    `paper` (protocol paper-wildghand).
    """
    same_data(results)
    means = [aggregate(score_rows(result)) for result in results]
    groups = _groups(means)
    tables = {
        "overall": add_validation_note(overall_table(results, groups, HEADLINE), results),
        "captures": capture_table(results, means),
        "perturbations": perturbation_table(results, means),
        "details": mean_table(results, groups, _of_protocol(HWP_V1)),
        "micro": mean_table(results, {ALL_FRAMES: [m.overall.micro for m in means]}, HEADLINE),
        "paper": mean_table(results, groups, PAPER, _PAPER_NOTE),
    }
    return {name: add_isolation_note(table, results) for name, table in tables.items()}


def overall_table(
    results: Sequence[Results], groups: Mapping[str, Sequence[Scores]], metrics: Sequence[str]
) -> Table:
    """Return one row per method: means, and what they cost."""
    table = mean_table(results, groups, metrics)
    costs: list[Filled] = [
        (Column("Fit [s]", 1, group="Cost"), [_fit_seconds(result) for result in results]),
        (
            Column("Render [frames/s]", 1, group="Cost"),
            [_render_rate(result) for result in results],
        ),
        (
            Column("Failed frames", 0, group="Cost"),
            [sum(capture.failed_frames for capture in result.captures) for result in results],
        ),
    ]
    return with_columns(table, costs)


def mean_table(
    results: Sequence[Results],
    groups: Mapping[str, Sequence[Scores]],
    metrics: Sequence[str],
    note: str = "",
) -> Table:
    """Return one row per method: means of `metrics` in each group of columns."""
    names = _present(results, metrics)
    columns: list[Filled] = [(Column("Method"), labels(results))]
    columns += [
        (score_column(name, title), [mean.get(name) for mean in means])
        for title, means in groups.items()
        for name in names
    ]
    what = "over captures of means over test frames"
    if ALL_FRAMES in groups:
        what = "over all test frames, each of which counts the same"
    scope = f"Every mean is {what}; {_scope(results)}."
    if MACRO in groups:
        scope += " Macro: the mean over perturbations, each over the captures with it."
    notes = tuple(text for text in (note, scope, makers_note(results)) if text)
    return table_of("All captures", columns, notes)


def _groups(means: Sequence[Aggregate]) -> dict[str, list[Scores]]:
    """Return the groups of columns that the captures call for."""
    groups = {}
    for title, key in (("Single", "single"), ("Interacting", "interacting")):
        summaries: list[Summary | None] = [getattr(mean, key) for mean in means]
        if any(summaries):
            groups[title] = [item.capture_mean if item else {} for item in summaries]
    if all(mean.overall.macro for mean in means):
        groups[MACRO] = [mean.overall.macro for mean in means]
    return groups


def capture_table(results: Sequence[Results], means: Sequence[Aggregate]) -> Table:
    """Return one row per method and capture."""
    names = _present(results, HEADLINE)
    ids = dict.fromkeys(capture.id for result in results for capture in result.captures)
    shown = [
        (capture, label, mean.overall.captures[identifier])
        for identifier in ids
        for label, result, mean in zip(labels(results), results, means, strict=True)
        for capture in result.captures
        if capture.id == identifier
    ]
    captures = [capture for capture, _, _ in shown]
    hands = ["interacting" if capture.hands == "both" else "single" for capture in captures]
    columns: list[Filled] = [
        (Column("Capture"), [capture.id for capture in captures]),
        (Column("Hands"), hands),
        (Column("Method"), [label for _, label, _ in shown]),
        *((score_column(name), [scores.get(name) for _, _, scores in shown]) for name in names),
        (Column("Fit [s]", 1), [capture.fit_seconds for capture in captures]),
        (Column("Failed frames", 0), [capture.failed_frames for capture in captures]),
    ]
    if any(capture.made_by for capture in captures):
        columns.append((Column("Made by"), [capture.made_by for capture in captures]))
    # Captures are of unequal difficulty: only methods on one capture are ranked. Lines between
    # captures are drawn where there are several methods.
    ranked = len(results) > 1
    breaks = block_breaks([capture.id for capture in captures]) if ranked else ()
    return table_of("Per capture", columns, ranked=ranked, breaks=breaks)


def perturbation_table(results: Sequence[Results], means: Sequence[Aggregate]) -> Table:
    """Return one row per method, with a group of columns per perturbation, as in the paper."""
    names = _present(results, HEADLINE[:3])
    present = [p for p in PERTURBATIONS if any(p in mean.overall.perturbations for mean in means)]
    columns: list[Filled] = [(Column("Method"), labels(results))]
    columns += [
        (
            score_column(name, perturbation(p).heading),
            [mean.overall.perturbations.get(p, {}).get(name) for mean in means],
        )
        for p in present
        for name in names
    ]
    note = "Mean over the captures with the perturbation; a capture may have several."
    return table_of("Per perturbation", columns, [note])


def same_data(results: Sequence[Results]) -> None:
    """Refuse captures of one name that differ in their data or their split."""
    seen: dict[str, CaptureResult] = {}
    for result in results:
        for capture in result.captures:
            first = seen.setdefault(capture.id, capture)
            data = (capture.digest, capture.split_digest)
            if (first.digest, first.split_digest) != data:
                raise UsageError(
                    "results on different data cannot stand in one table"
                    + differing_makers(first, capture),
                    where=capture.id,
                    remedy="Evaluate the methods on the same captures with the same splits.",
                )


def makers_note(results: Sequence[Results]) -> str:
    """Return which importer made which captures, for a line under a table; empty if none."""
    makers: dict[str, list[str]] = {}
    for identifier, maker in dict.fromkeys(
        (capture.id, capture.made_by) for result in results for capture in result.captures
    ):
        if maker:
            makers.setdefault(maker, []).append(identifier)
    parts = [f"{', '.join(found)} by {maker}" for maker, found in makers.items()]
    return f"Hands and masks were made by an importer: {'; '.join(parts)}." if parts else ""


def _present(results: Sequence[Results], metrics: Sequence[str]) -> list[str]:
    measured = {name for result in results for name in result.metrics}
    return [name for name in metrics if name in measured]


def _of_protocol(protocol: Protocol) -> tuple[str, ...]:
    return tuple(facts.name for facts in METRICS if facts.protocol == protocol.name)


def labels(results: Sequence[Results], *, seeds: bool = True) -> list[str]:
    """Return a title for each evaluation, with what differs where titles repeat.

    Without `seeds` each stands for all seeds of its method.
    """
    told, telling = [], [text for text in _TELLING if seeds or text is not _seed]
    for result, settings in zip(results, differing_settings(results), strict=True):
        twins = [other for other in results if other.method.title == result.method.title]
        parts = [text(result) for text in telling if len({text(twin) for twin in twins}) > 1]
        parts += [settings] if settings else []
        if not parts and len(twins) > 1:
            parts = [text(result) for text in telling]
        told.append(result.method.title + (f" ({', '.join(parts)})" if parts else ""))
    return told


def _seed(result: Results) -> str:
    return f"seed {result.seed}"


#: The differences between evaluations of one title.
_TELLING: tuple[Callable[[Results], str], ...] = (
    lambda result: result.method.preset,
    lambda result: f"{result.frames} frames",
    lambda result: budget_text(result.budget),
    _seed,
    lambda result: ", ".join(f"files {one[:8]}" for one in shown_files(result)) or "no files",
    lambda result: result.method.digest[:8],
)


def _fit_seconds(result: Results) -> float | None:
    """Mean seconds of a fit; None where no capture says any."""
    fits = [c.fit_seconds for c in result.captures if c.fit_seconds is not None]
    return sum(fits) / len(fits) if fits else None


def _render_rate(result: Results) -> float | None:
    """Frames a second, over the captures that say how long they were rendered."""
    timed = [c for c in result.captures if c.render_seconds is not None]
    frames = sum(len(capture.frames) for capture in timed)
    return per_second(frames, sum(capture.render_seconds or 0.0 for capture in timed))


def _scope(results: Sequence[Results]) -> str:
    every = set()
    for result in results:
        captures, frames = len(result.captures), sum(len(c.frames) for c in result.captures)
        text = f"{result.suite}: {captures} captures, {frames} test frames"
        every.add((result.suite, captures, frames, ", ".join([text, *lost_clips(result)])))
    return "; ".join(text for *_, text in sorted(every))


_NOTE = (
    "Means over seeds, where a method has several; counts, such as failed frames, are added up. "
    "`--by seeds` shows how they spread."
)
#: Heading of the column that names evaluations.
_METHOD = "Method"


def over_seeds(table: Table, results: Sequence[Results]) -> Table:
    """Merge the rows of a table that differ in nothing but the seed.

    Measurements become means. Counts to the right of the method's name are added up, and texts
    there are joined.
    """
    try:
        runs = group_runs(results)
    except UsageError:
        return table
    if len(runs) == len(results):
        return table
    names = dict(zip(map(id, results), labels(results), strict=True))
    titles = {
        names[id(result)]: title
        for run, title in zip(runs, labels([run.first for run in runs], seeds=False), strict=True)
        for result in run.seeds.values()
    }
    place = [column.title for column in table.columns].index(_METHOD)
    edges = {*table.breaks, 0}
    block = 0
    merged: dict[tuple[object, ...], list[int]] = {}
    for number, row in enumerate(table.rows):
        block += number in edges
        named = (block, *row[:place], titles[str(row[place])])
        merged.setdefault(named, []).append(number)
    rows: list[tuple[Cell, ...]] = []
    breaks: list[int] = []
    for key, members in merged.items():
        if members[0] in table.breaks:
            breaks.append(len(rows))
        tails = [table.rows[number][place + 1 :] for number in members]
        means = [_merged(values) for values in zip(*tails, strict=True)]
        rows.append((*table.rows[members[0]][:place], str(key[-1]), *means))
    unranked = frozenset(
        index for index, members in enumerate(merged.values()) if table.unranked.issuperset(members)
    )
    return replace(
        table,
        rows=tuple(rows),
        breaks=tuple(breaks),
        unranked=unranked,
        notes=(*table.notes, _NOTE),
    )


def _merged(values: Sequence[Cell]) -> Cell:
    """Mean of measurements, sum of counts, texts joined; None where one of them is missing."""
    if any(value is None for value in values):
        return None
    numbers = [value for value in values if isinstance(value, int | float)]
    if len(numbers) < len(values):
        return ", ".join(dict.fromkeys(str(value) for value in values))
    if all(isinstance(value, int) for value in numbers):
        return sum(numbers)
    return sum(numbers) / len(numbers)


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
    """Return one row per capture and method, and one per method over all captures.

    Seeds of a method are averaged. Failed frames are counted where there are any. `all` is the
    mean over the captures that every method has scores of, each of which counts the same.
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
    blocks = [(one, [one]) for one in common]
    blocks += [(ALL, common)] if len(common) > 1 else []
    shown = [
        (title, run, captures, [found[run.label][capture] for capture in captures])
        for title, captures in blocks
        for run in runs
    ]
    clips = [own for _, _, _, own in shown]
    estimates = [
        bootstrap_mean([_values(clip, MAIN) for clip in own], resamples=_RESAMPLES) for own in clips
    ]
    main = score_column(MAIN)
    columns: list[Filled] = [
        (Column("Capture"), [title for title, _, _, _ in shown]),
        (Column("Method"), [run.label for _, run, _, _ in shown]),
        (main, [estimate.value for estimate in estimates]),
        (Column("Low", main.digits, group=_INTERVAL), [one.low for one in estimates]),
        (Column("High", main.digits, group=_INTERVAL), [one.high for one in estimates]),
    ]
    for name in names:
        means = [float(np.mean([_values(clip, name).mean() for clip in own])) for own in clips]
        columns.append((score_column(name), means))
    tests = [_test(run, captures) for _, run, captures, _ in shown]
    columns.append((Column(main.title, main.digits, group=_TEST), tests))
    failed = [
        sum(frame.failure is not None for clip in own for one in clip for frame in one.frames)
        for own in clips
    ]
    columns += [(Column("Failed", 0), failed)] if any(failed) else []
    breaks = block_breaks([title for title, _, _, _ in shown])
    return table_of("Novel views", columns, _NOTES, breaks=breaks)


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


def _test(run: MethodRuns, captures: Sequence[str]) -> float:
    """Mean over captures of the mean over seeds and test frames."""
    seeds = sorted(run.seeds)
    return float(np.mean([run.values(name, MAIN, seeds).mean() for name in captures]))
