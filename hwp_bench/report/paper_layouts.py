"""The layouts of the paper's tables, filled with measured and, if asked for, published rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hwp_bench.analysis.pairing import MethodRuns
from hwp_bench.base.errors import UsageError
from hwp_bench.base.tables import Cell, Column, Table, without_empty_columns
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.metrics.score import Scores, aggregate, mean_scores
from hwp_bench.results.published import MARK, NOTE, Measurement, read_published
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

#: The cells of a row.
Row = tuple[Cell, ...]

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
    published = read_published()
    names = [perturbation(name).title for name in PERTURBATIONS]
    keys = ("clean_test", "single", "interacting", *PERTURBATIONS)
    heads = ["Data set", "Environment", "Clean test", "Single", "Interacting", *names]
    caption, notes = "Hand video data sets", [f"Published in {published.title}, table 1."]
    rows: list[Row] = [
        (item.name, item.environment, *_ticks(key in item.has for key in keys))
        for item in published.datasets
    ]
    if number == 2:
        heads = ["Capture", "Hand", "Action", "Device", "Frames", *names]
        caption, notes = "The captures of the HWP data set", []
        rows = [
            (
                *(entry.id, entry.hands, entry.action, entry.device, str(entry.frame_count)),
                *_ticks(name in entry.perturbations for name in PERTURBATIONS),
            )
            for entry in catalogue().values()
        ]
    return Table(caption, tuple(map(Column, heads)), tuple(rows), tuple(notes))


def _ticks(present: Iterable[bool]) -> list[str]:
    return ["✓" if here else "" for here in present]


def _layout(
    number: int,
    caption: str,
    columns: Iterable[Column],
    rows: Sequence[Row],
    published: Sequence[Row],
    notes: Sequence[str],
    **options: Any,
) -> Table:
    """Return a table with its published rows, which are never ranked, under the measured ones."""
    count, every = len(rows), (*rows, *published)
    if published:
        page = read_published().table(number).page
        source = f"table {number}, page {page}" if page and number <= 8 else f"table {number}"
        notes = [*notes, f"{NOTE} Source: {source}."]
    return Table(
        f"{caption} (layout of table {number})",
        tuple(columns),
        every,
        tuple(notes),
        breaks=(count,) if 0 < count < len(every) else (),
        unranked=frozenset(range(count, len(every))),
        **options,
    )


def layout_table(
    layout: Layout,
    runs: Sequence[MethodRuns],
    published: bool = False,
    marks: Marks | None = None,
) -> Table:
    """Return one of the tables 3 to 8.

    Scores are of protocol paper-wildghand, means over captures and then over seeds. Without
    LPIPS weights the oriented distance is added, in a column under its own name.
    """
    shown = {
        scope: heading
        for scope, heading in layout.scopes.items()
        if scope not in _ELSEWHERE or published
    }
    metrics = _metrics(runs, published)
    components = layout.components if published else ()
    if marks:
        components = tuple(next(iter(marks.values())))
    heads = [Column("Variant" if layout.variants else "Method"), *map(Column, components)]
    heads += [_column(name, heading) for heading in shown.values() for name in metrics]
    rows: list[Row] = []
    for run in runs:
        means = _means(run)
        there = (marks or {}).get(run.first.method.title, {})
        ticks = _ticks(there.get(name, False) for name in components)
        cells = [means.get(scope, {}).get(METRIC_OF.get(m, m)) for scope in shown for m in metrics]
        rows.append((run.label, *ticks, *cells))
    found: list[Row] = []
    scopes_of: dict[tuple[str, str], dict[str, Measurement]] = {}
    for item in read_published().table(layout.number).measurements if published else ():
        scopes_of.setdefault((item.method, item.detail), {})[item.scope] = item
    for (method, detail), by_scope in scopes_of.items():
        ticks = _ticks(name in detail.split(", ") for name in components)
        label = method if components else f"{method} {detail}".strip()
        scores = [by_scope[scope].scores if scope in by_scope else {} for scope in shown]
        cells = [own.get(name) for own in scores for name in metrics]
        found.append((f"{label} ({MARK})", *ticks, *cells))
    table = _layout(layout.number, layout.caption, heads, rows, found, _notes(runs))
    return without_empty_columns(table)


def _metrics(runs: Sequence[MethodRuns], published: bool) -> list[str]:
    """Return the metrics, under their published names where they have one."""
    known = [set(result.metrics) for run in runs for result in run.seeds.values()]
    lpips = bool(known) and all("paper_lpips" in names for names in known)
    metrics = ["psnr", "ssim", *(["lpips"] if lpips or published else [])]
    if not lpips and known and all(DISTANCE in names for names in known):
        metrics.append(DISTANCE)
    return metrics


def _column(name: str, group: str = "") -> Column:
    facts = metric_facts(METRIC_OF.get(name, name))
    digits = PAPER_DIGITS.get(name, facts.digits)
    return Column(facts.label, digits, facts.higher_is_better, group)


def _means(run: MethodRuns) -> dict[str, Scores]:
    """Return mean scores over seeds by scope."""
    found: dict[str, list[Scores]] = {}
    for result in run.seeds.values():
        mean = aggregate(score_rows(result))
        # The paper's table by perturbation is only of interacting hands.
        scopes = dict(mean.interacting.perturbations) if mean.interacting else {}
        groups = (("all", mean.overall), ("single", mean.single), ("interacting", mean.interacting))
        scopes |= {name: summary.capture_mean for name, summary in groups if summary is not None}
        for scope, scores in scopes.items():
            found.setdefault(scope, []).append(scores)
    return {scope: mean_scores(rows) for scope, rows in found.items()}


def _notes(runs: Sequence[MethodRuns]) -> list[str]:
    if not runs:
        return []
    first = runs[0].first
    counts = {run.label: len(run.seeds) for run in runs}
    seeds = f"{len(runs[0].seeds)} seed(s)"
    if len(set(counts.values())) > 1:
        seeds = f"seeds ({', '.join(f'{name} {count}' for name, count in counts.items())})"
    return [
        f"Measured rows: {first.suite}, {len(first.captures)} captures, protocol paper-wildghand; "
        f"means over captures of means over test frames, over {seeds}.",
    ]


def seeds_layout(runs: Sequence[MethodRuns], published: bool = False) -> Table:
    """Return the layout of table 10: mean and standard deviation over seeds, in one cell."""

    def cell(mean: float, deviation: float | None) -> str:
        return f"{mean:.4f}" + (f" ± {deviation:.4f}" if deviation is not None else "")

    metrics = _metrics(runs, published)
    rows: list[Row] = []
    for run in runs:
        every = [aggregate(score_rows(one)).overall.capture_mean for one in run.seeds.values()]
        cells: list[Cell] = []
        for name in metrics:
            found = [means.get(METRIC_OF.get(name, name)) for means in every]
            scores = [score for score in found if score is not None]
            spread = float(np.std(scores, ddof=1)) if len(scores) > 1 else None
            whole = len(scores) == len(every)
            cells.append(cell(float(np.mean(scores)), spread) if whole else None)
        rows.append((run.label, *cells))
    told = [
        (
            f"{item.method} ({MARK})",
            *(
                cell(item.scores[name], item.deviations.get(name)) if name in item.scores else None
                for name in metrics
            ),
        )
        for item in (read_published().table(10).measurements if published else ())
    ]
    heads = [Column("Method"), *map(_column, metrics)]
    caption = "Mean and standard deviation over seeds"
    return _layout(10, caption, heads, rows, told, _notes(runs), ranked=False)


def bias_layout(
    measured: Sequence[Row], metrics: Sequence[str], notes: Sequence[str], published: bool = False
) -> Table:
    """Return the layout of table 9."""
    names = {value: key for key, value in METRIC_OF.items()}
    heads = [Column("Capture"), Column("Disturbance")]
    heads += [_column(names.get(name, name)) for name in metrics]
    heads.append(Column("Avg. T. Wt. [1e-3]", 3))
    several = len({row[3] for row in measured}) > 1
    rows = [(f"{row[0]}, {row[3]}" if several else row[0], row[1], *row[4:]) for row in measured]
    told = [
        (
            f"{item.scope} ({MARK})",
            item.detail,
            *(item.scores.get(names.get(name, name)) for name in metrics),
            item.scores["temporal_weight_e3"],
        )
        for item in (read_published().table(9).measurements if published else ())
    ]
    if not rows and not told:
        raise UsageError("none of these methods left temporal weights", field="RESULTS")
    caption = "Mean temporal weight and perturbation level"
    return _layout(9, caption, heads, rows, told, notes, ranked=False)
