"""The tables of an evaluation: overall, per capture, per perturbation, in both protocols."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from hwp_bench.base.errors import UsageError
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.metrics import HWP_V1, METRICS, Protocol, metric
from hwp_bench.metrics.score import Aggregate, Scores, Summary, aggregate
from hwp_bench.results import CaptureResult, Results
from hwp_bench.results.bounds import per_second
from hwp_bench.results.schema import differing_makers, differing_settings, score_rows
from hwp_bench.results.walls import noted
from hwp_bench.taxonomy import PERTURBATIONS, perturbation

#: Metrics of the headline tables, where an evaluation has them.
HEADLINE = ("psnr", "ssim", "oriented_distance", "lpips_alex", "lpips_vgg")
#: Metrics of the tables in the paper's protocol.
PAPER = ("paper_psnr", "paper_ssim", "paper_lpips")
#: Heading of the mean over perturbations.
MACRO = "Macro"

_PAPER_NOTE = (
    "Protocol paper-wildghand: the released evaluator's settings with the data set's mask; "
    "these numbers are not comparable with the headline's."
)


def all_tables(results: Sequence[Results]) -> dict[str, Table]:
    """Return every table of one or several evaluations, by name.

    `overall` (single, interacting, macro mean, with cost), `captures`, `perturbations`,
    `details` (every metric of protocol hwp-v1), `micro` (every frame counts the same) and
    `paper` (protocol paper-wildghand).

    Raises:
        UsageError: evaluations of one name were made on different data.
    """
    same_data(results)
    means = [aggregate(score_rows(result)) for result in results]
    groups = _groups(means)
    tables = {
        "overall": overall_table(results, groups, HEADLINE),
        "captures": capture_table(results, means),
        "perturbations": perturbation_table(results, means),
        "details": mean_table(results, groups, _of_protocol(HWP_V1)),
        "micro": mean_table(results, {"All frames": [m.overall.micro for m in means]}, HEADLINE),
        "paper": mean_table(results, groups, PAPER, _PAPER_NOTE),
    }
    return {name: noted(table, results) for name, table in tables.items()}


def overall_table(
    results: Sequence[Results], groups: Mapping[str, Sequence[Scores]], metrics: Sequence[str]
) -> Table:
    """Return one row a method: means, and what they cost.

    Args:
        results: the evaluations.
        groups: for each group of columns, the means of every evaluation.
        metrics: which metrics; those that an evaluation lacks are left out.
    """
    table = mean_table(results, groups, metrics)
    columns = [
        Column("Fit [s]", 1, group="Cost"),
        Column("Render [frames/s]", 1, group="Cost"),
        Column("Failed frames", 0, group="Cost"),
    ]
    rows = [(*row, *_cost(result)) for row, result in zip(table.rows, results, strict=True)]
    return replace(table, columns=(*table.columns, *columns), rows=tuple(rows))


def mean_table(
    results: Sequence[Results],
    groups: Mapping[str, Sequence[Scores]],
    metrics: Sequence[str],
    note: str = "",
) -> Table:
    """Return one row a method: means of `metrics` in each group of columns."""
    names = _present(results, metrics)
    columns = [Column("Method")]
    columns += [score_column(name, title) for title in groups for name in names]
    rows = [
        (label, *(means[index].get(name) for means in groups.values() for name in names))
        for index, label in enumerate(labels(results))
    ]
    scope = f"Every mean is over captures of means over test frames; {_scope(results)}."
    if MACRO in groups:
        scope += " Macro: the mean over perturbations, each over the captures with it."
    notes = tuple(text for text in (note, scope, makers_note(results)) if text)
    return Table("All captures", tuple(columns), tuple(rows), notes)


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
    """Return one row a method and capture."""
    names = _present(results, HEADLINE)
    columns = [Column("Capture"), Column("Hands"), Column("Method")]
    columns += [score_column(name) for name in names]
    columns += [Column("Fit [s]", 1), Column("Failed frames", 0)]
    imported = any(capture.made_by for result in results for capture in result.captures)
    columns += [Column("Made by")] if imported else []
    rows: list[tuple[Cell, ...]] = []
    breaks = []
    for identifier in dict.fromkeys(c.id for result in results for c in result.captures):
        breaks.append(len(rows))
        for label, result, mean in zip(labels(results), results, means, strict=True):
            for capture in result.captures:
                if capture.id == identifier:
                    scores = [mean.overall.captures[identifier].get(name) for name in names]
                    hands = "interacting" if capture.hands == "both" else "single"
                    tail = (capture.fit_seconds, capture.failed_frames)
                    maker = (capture.made_by,) if imported else ()
                    rows.append((identifier, hands, label, *scores, *tail, *maker))
    # Captures are of unequal difficulty: only methods on one capture are ranked. Lines between
    # captures are drawn where there are several methods.
    separate = tuple(breaks[1:])
    ranked = len(results) > 1
    return Table(
        "Per capture", tuple(columns), tuple(rows), ranked=ranked, breaks=separate if ranked else ()
    )


def perturbation_table(results: Sequence[Results], means: Sequence[Aggregate]) -> Table:
    """Return one row a method, one group of columns a perturbation, as the paper's table."""
    names = _present(results, HEADLINE[:3])
    present = [p for p in PERTURBATIONS if any(p in mean.overall.perturbations for mean in means)]
    columns = [Column("Method")]
    columns += [score_column(name, perturbation(p).heading) for p in present for name in names]
    rows = [
        (
            label,
            *(mean.overall.perturbations.get(p, {}).get(name) for p in present for name in names),
        )
        for label, mean in zip(labels(results), means, strict=True)
    ]
    note = "Mean over the captures with the perturbation; a capture may have several."
    return Table("Per perturbation", tuple(columns), tuple(rows), (note,))


def same_data(results: Sequence[Results]) -> None:
    """Refuse captures of one name that differ in their data or their split.

    Raises:
        UsageError: naming the capture.
    """
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


def score_column(name: str, group: str = "") -> Column:
    """Return the column of a metric: label and unit, digits, direction."""
    facts = metric(name)
    title = f"{facts.label} [{facts.unit}]" if facts.unit else facts.label
    return Column(title, facts.digits, facts.higher_is_better, group)


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


def labels(results: Sequence[Results]) -> list[str]:
    """Return a title for each evaluation, with what differs where titles repeat."""
    told = []
    for result, settings in zip(results, differing_settings(results), strict=True):
        twins = [other for other in results if other.method.title == result.method.title]
        parts = [text(result) for text in _TELLING if len({text(twin) for twin in twins}) > 1]
        parts += [settings] if settings else []
        if not parts and len(twins) > 1:
            parts = [text(result) for text in _TELLING]
        told.append(result.method.title + (f" ({', '.join(parts)})" if parts else ""))
    return told


#: The differences between evaluations of one title.
_TELLING: tuple[Callable[[Results], str], ...] = (
    lambda result: result.method.preset,
    lambda result: f"{result.frames} frames",
    lambda result: (
        ", ".join(f"{value:g} {name}" for name, value in result.budget.items() if value)
        or "no limit"
    ),
    lambda result: f"seed {result.seed}",
    lambda result: result.method.digest[:8],
)


def _cost(result: Results) -> list[Cell]:
    fits = [c.fit_seconds for c in result.captures if c.fit_seconds is not None]
    renders = [
        (len(c.frames), c.render_seconds) for c in result.captures if c.render_seconds is not None
    ]
    seconds = sum(spent for _, spent in renders)
    return [
        sum(fits) / len(fits) if fits else None,
        per_second(sum(count for count, _ in renders), seconds),
        sum(capture.failed_frames for capture in result.captures),
    ]


def _scope(results: Sequence[Results]) -> str:
    counts = {
        (result.suite, len(result.captures), sum(len(c.frames) for c in result.captures))
        for result in results
    }
    return "; ".join(
        f"{suite}: {captures} captures, {frames} test frames"
        for suite, captures, frames in sorted(counts)
    )
