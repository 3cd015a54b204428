"""The layouts of the paper's tables, filled with measured and, if asked for, published rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from hwp_bench.analysis.pairing import MethodRuns
from hwp_bench.base.errors import UsageError
from hwp_bench.base.tables import Cell, Column, Table, without_empty_columns
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.metrics.score import Scores, Summary, aggregate, mean_scores
from hwp_bench.results.published import MARK, NOTE, Measurement, PublishedTable, read_published
from hwp_bench.results.schema import score_rows
from hwp_bench.taxonomy import PERTURBATIONS, catalogue, perturbation

#: Published metrics, and the measured metrics that correspond to them.
METRIC_OF = {"psnr": "paper_psnr", "ssim": "paper_ssim", "lpips": "paper_lpips"}
#: Digits that the paper prints.
PAPER_DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3}
#: The distance that needs no downloaded weights.
DISTANCE = "oriented_distance"

#: For each variant, by its title: component title -> True where the variant has it.
Marks = Mapping[str, Mapping[str, bool]]

_PERTURBED = {name: perturbation(name).heading for name in PERTURBATIONS}
_ELSEWHERE = {"interhand2.6m": "InterHand2.6M (Inter.)", "anchorcrafter": "AnchorCrafter (Inter.)"}


@dataclass(frozen=True)
class Layout:
    """The columns of a table of the paper."""

    #: Its number in the paper, in Arabic digits.
    number: int
    #: Its caption.
    caption: str
    #: Heading of each group of columns by scope.
    scopes: Mapping[str, str]
    #: True where it compares variants of one method.
    variants: bool = False
    #: Components whose presence the published rows state.
    components: tuple[str, ...] = ()


LAYOUTS: Mapping[int, Layout] = {
    layout.number: layout
    for layout in (
        Layout(
            3,
            "Comparison of methods",
            {"single": "HWP (Single)", "interacting": "HWP (Inter.)", **_ELSEWHERE},
        ),
        Layout(4, "Comparison on own videos", {"all": ""}),
        Layout(5, "Interacting hands by perturbation", _PERTURBED),
        Layout(
            6,
            "Ablation of the components",
            {"single": "Single Hand", "interacting": "Interacting Hands"},
            variants=True,
            components=("DPD", "PAO"),
        ),
        Layout(7, "Weights and a binary mask", {"all": ""}, variants=True),
        Layout(8, "Ablation of the prediction heads", {"all": ""}, variants=True),
    )
}


def fact_table(number: int) -> Table:
    """Return table 1 (data sets, as published) or 2 (the captures); neither has measurements."""
    names = [perturbation(name).title for name in PERTURBATIONS]
    if number == 1:
        keys = ("clean_test", "single", "interacting", *PERTURBATIONS)
        heads = ("Data set", "Environment", "Clean test", "Single", "Interacting", *names)
        rows = tuple(
            (item.name, item.environment, *_ticks(key in item.has for key in keys))
            for item in read_published().datasets
        )
        note = f"Published in {read_published().title}, table 1."
        return Table("Hand video data sets", tuple(map(Column, heads)), rows, (note,))
    heads = ("Capture", "Hand", "Action", "Device", "Frames", *names)
    rows = tuple(
        (
            entry.id,
            entry.hands,
            entry.action,
            entry.device,
            str(entry.frame_count),
            *_ticks(name in entry.perturbations for name in PERTURBATIONS),
        )
        for entry in catalogue().values()
    )
    return Table("The captures of the HWP data set", tuple(map(Column, heads)), rows)


def _ticks(present: Iterable[bool]) -> list[str]:
    return ["✓" if here else "" for here in present]


def layout_table(
    layout: Layout,
    runs: Sequence[MethodRuns],
    published: bool = False,
    marks: Marks | None = None,
) -> Table:
    """Return one of the tables 3 to 8.

    Scores are of protocol paper-wildghand, means over captures and then over seeds. Without
    LPIPS weights the oriented distance is added, in a column under its own name.

    Args:
        layout: which.
        runs: the methods or variants; may be empty where `published` is set.
        published: append the paper's numbers, marked.
        marks: the components of each variant; None shows labels only.
    """
    shown = {
        scope: heading
        for scope, heading in layout.scopes.items()
        if scope not in _ELSEWHERE or published
    }
    table = read_published().table(layout.number)
    metrics, columns = _metric_columns(runs, published)
    components = layout.components if published else ()
    if marks:
        components = tuple(next(iter(marks.values())))
    heads = [Column("Variant" if layout.variants else "Method"), *map(Column, components)]
    for heading in shown.values():
        heads += [Column(c.title, c.digits, c.higher_is_better, heading) for c in columns]
    rows: list[tuple[Cell, ...]] = []
    for run in runs:
        means = _means(run)
        there = (marks or {}).get(run.first.method.title, {})
        ticks = _ticks(there.get(name, False) for name in components)
        cells = [means.get(scope, {}).get(METRIC_OF.get(m, m)) for scope in shown for m in metrics]
        rows.append((run.label, *ticks, *cells))
    measured = len(rows)
    if published:
        rows += _published_rows(table, list(shown), metrics, components)
    page = f", page {table.page}" if table.page else ""
    notes = _notes(runs)
    notes += (f"{NOTE} Source: table {table.number}{page}.",) if published else ()
    made = Table(
        f"{layout.caption} (layout of table {layout.number})",
        tuple(heads),
        tuple(rows),
        notes,
        breaks=(measured,) if 0 < measured < len(rows) else (),
        unranked=frozenset(range(measured, len(rows))),
    )
    return without_empty_columns(made)


def _metric_columns(runs: Sequence[MethodRuns], published: bool) -> tuple[list[str], list[Column]]:
    """Return the metrics, published names where there are, and their columns."""
    known = [set(result.metrics) for run in runs for result in run.seeds.values()]
    lpips = bool(known) and all("paper_lpips" in names for names in known)
    metrics = ["psnr", "ssim", *(["lpips"] if lpips or published else [])]
    if not lpips and known and all(DISTANCE in names for names in known):
        metrics.append(DISTANCE)
    columns = []
    for name in metrics:
        facts = metric_facts(METRIC_OF.get(name, name))
        digits = PAPER_DIGITS.get(name, facts.digits)
        columns.append(Column(facts.label, digits, facts.higher_is_better))
    return metrics, columns


def _means(run: MethodRuns) -> dict[str, Scores]:
    """Return mean scores over seeds by scope."""
    found: dict[str, list[Scores]] = {}
    for result in run.seeds.values():
        mean = aggregate(score_rows(result))
        found.setdefault("all", []).append(mean.overall.capture_mean)
        groups: dict[str, Summary | None] = {
            "single": mean.single,
            "interacting": mean.interacting,
        }
        for scope, summary in groups.items():
            if summary is not None:
                found.setdefault(scope, []).append(summary.capture_mean)
        # The paper's table by perturbation is only of interacting hands.
        for name, scores in (mean.interacting.perturbations if mean.interacting else {}).items():
            found.setdefault(name, []).append(scores)
    return {scope: mean_scores(rows) for scope, rows in found.items()}


def _published_rows(
    table: PublishedTable, scopes: Sequence[str], metrics: Sequence[str], components: Sequence[str]
) -> list[tuple[Cell, ...]]:
    rows: dict[tuple[str, str], dict[str, Measurement]] = {}
    for item in table.measurements:
        rows.setdefault((item.method, item.detail), {})[item.scope] = item
    found = []
    for (method, detail), by_scope in rows.items():
        ticks = _ticks(name in detail.split(", ") for name in components)
        label = method if components else f"{method} {detail}".strip()
        cells = [
            by_scope[scope].scores.get(name) if scope in by_scope else None
            for scope in scopes
            for name in metrics
        ]
        found.append((f"{label} ({MARK})", *ticks, *cells))
    return found


def _notes(runs: Sequence[MethodRuns]) -> tuple[str, ...]:
    if not runs:
        return ()
    first = runs[0].first
    seeds = max(len(run.seeds) for run in runs)
    return (
        f"Measured rows: {first.suite}, {len(first.captures)} captures, protocol paper-wildghand; "
        f"means over captures of means over test frames, over {seeds} seed(s).",
    )


def seeds_layout(runs: Sequence[MethodRuns], published: bool = False) -> Table:
    """Return the layout of table 10: mean and standard deviation over seeds, in one cell."""
    import numpy as np

    metrics, columns = _metric_columns(runs, published)
    rows: list[tuple[Cell, ...]] = []
    for run in runs:
        cells: list[Cell] = []
        for name in metrics:
            key = METRIC_OF.get(name, name)
            by_seed = [
                aggregate(score_rows(result)).overall.capture_mean for result in run.seeds.values()
            ]
            if not all(key in means for means in by_seed):
                cells.append(None)
                continue
            means = [found[key] for found in by_seed]
            spread = float(np.std(means, ddof=1)) if len(means) > 1 else None
            cells.append(_plus_minus(float(np.mean(means)), spread))
        rows.append((run.label, *cells))
    measured = len(rows)
    table = read_published().table(10)
    if published:
        for item in table.measurements:
            texts = [
                _plus_minus(item.scores[name], item.deviations.get(name))
                if name in item.scores
                else None
                for name in metrics
            ]
            rows.append((f"{item.method} ({MARK})", *texts))
    heads = (Column("Method"), *columns)
    notes = (*_notes(runs), *((f"{NOTE} Source: table 10.",) if published else ()))
    caption = "Mean and standard deviation over seeds (layout of table 10)"
    breaks = (measured,) if 0 < measured < len(rows) else ()
    return Table(caption, heads, tuple(rows), notes, ranked=False, breaks=breaks)


def _plus_minus(mean: float, deviation: float | None) -> str:
    return f"{mean:.4f} ± {deviation:.4f}" if deviation is not None else f"{mean:.4f}"


def bias_layout(
    measured: Sequence[tuple[Cell, ...]], metrics: Sequence[str], published: bool = False
) -> Table:
    """Return the layout of table 9.

    Args:
        measured: rows of `study_tables.bias_rows`.
        metrics: the metrics of those rows.
        published: append the paper's rows, marked.

    Raises:
        UsageError: there is nothing to show.
    """
    names = {value: key for key, value in METRIC_OF.items()}
    heads = [Column("Capture"), Column("Disturbance")]
    for name in metrics:
        facts = metric_facts(name)
        digits = PAPER_DIGITS.get(names.get(name, name), facts.digits)
        heads.append(Column(facts.label, digits, facts.higher_is_better))
    heads.append(Column("Avg. T. Wt. [1e-3]", 3))
    several = len({row[3] for row in measured}) > 1
    rows: list[tuple[Cell, ...]] = [
        (f"{row[0]}, {row[3]}" if several else row[0], row[1], *row[4:]) for row in measured
    ]
    count = len(rows)
    if published:
        for item in read_published().table(9).measurements:
            scores = [item.scores.get(names.get(name, name)) for name in metrics]
            label = f"{item.scope} ({MARK})"
            rows.append((label, item.detail, *scores, item.scores["temporal_weight_e3"]))
    if not rows:
        raise UsageError("none of these methods left temporal weights", field="RESULTS")
    notes = (f"{NOTE} Source: table 9.",) if published else ()
    caption = "Mean temporal weight and perturbation level (layout of table 9)"
    breaks = (count,) if 0 < count < len(rows) else ()
    return Table(caption, tuple(heads), tuple(rows), notes, ranked=False, breaks=breaks)
