"""The tables of accuracy against time."""

from __future__ import annotations

from collections.abc import Sequence

from hwp_bench.analysis.cost.front import FrontPart
from hwp_bench.analysis.cost.summary import MethodCost, Reach
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.results import Results

_GB = 1e9


def cost_tables(
    costs: Sequence[MethodCost],
    front: Sequence[FrontPart],
    metric: str,
    *,
    reference: str | None,
    stretch: tuple[float, float] | None,
    notes: Sequence[str] = (),
) -> dict[str, Table]:
    """Return the tables by name: `cost`, `times`, `front`.

    Args:
        costs: what `method_costs` returned.
        front: what `pareto_front` returned.
        metric: the metric of the scores.
        reference: label of the method whose final score is a target; None without one.
        stretch: what `window` returned.
        notes: further lines under the first table.
    """
    return {
        "cost": _cost_table(costs, metric, reference, stretch, notes),
        "times": _times_table(costs),
        "front": _front_table(front, metric),
    }


def _cost_table(
    costs: Sequence[MethodCost],
    metric: str,
    reference: str | None,
    stretch: tuple[float, float] | None,
    notes: Sequence[str],
) -> Table:
    facts = metric_facts(metric)
    better = facts.higher_is_better
    score = f"{facts.label} [{facts.unit}]" if facts.unit else facts.label
    columns = [Column("Method")]
    budgets = list(costs[0].at)
    columns += [
        Column(f"{budget:g} s", facts.digits, better, f"{score} after") for budget in budgets
    ]
    columns += [Column("Final", facts.digits, better, score)]
    if stretch:
        columns.append(Column("Mean over log time", facts.digits, better, score))
    if reference is not None:
        columns.append(Column(f"To final of {reference}", 1, False, "Seconds"))
        columns.append(Column("Fits that get there"))
    near = list(costs[0].to_own)
    columns += [Column(f"To own final within {step:g} dB", 1, False, "Seconds") for step in near]
    rows = []
    for cost in costs:
        row: list[Cell] = [cost.label, *(cost.at[budget] for budget in budgets), cost.final]
        if stretch:
            row.append(cost.area)
        if reference is not None:
            row += _reach_cells(cost.to_reference)
        row += [cost.to_own[step].seconds for step in near]
        rows.append(tuple(row))
    text = [
        "Scores on validation frames, outside the method's clock; means over captures and seeds, "
        "linear in the log of time between checkpoints. A fit that has ended keeps its score.",
        "Seconds to a score: median over fits; none where fewer than half get there.",
    ]
    if stretch:
        text.append(f"Mean over log time: from {stretch[0]:.3g} to {stretch[1]:.3g} s.")
    lost = [f"{cost.label}: {cost.fits - cost.curves}" for cost in costs if cost.curves < cost.fits]
    if lost:
        text.append(f"Fits without a curve, left out: {'; '.join(lost)}.")
    return Table("Accuracy against time", tuple(columns), tuple(rows), (*text, *notes))


def _reach_cells(reach: Reach | None) -> list[Cell]:
    return [None, None] if reach is None else [reach.seconds, f"{reach.reached} of {reach.fits}"]


def _times_table(costs: Sequence[MethodCost]) -> Table:
    columns = (
        Column("Method"),
        Column("Fit [s]", 1),
        Column("Steps", 0),
        Column("Step [ms]", 1),
        Column("Render [ms/frame]", 1),
        Column("Render [frames/s]", 1),
        Column("Score [ms/frame]", 1),
        Column("Whole process [s]", 1),
        Column("Peak memory [GB]", 2),
        Column("Device"),
    )
    rows = tuple(
        (
            cost.label,
            cost.fit_seconds,
            cost.steps,
            1000 * cost.fit_seconds / cost.steps if cost.fit_seconds and cost.steps else None,
            1000 * cost.render_seconds if cost.render_seconds else None,
            cost.frames_per_second,
            1000 * cost.score_seconds,
            cost.wall_seconds,
            cost.peak_memory / _GB if cost.peak_memory else None,
            ", ".join(cost.devices) or None,
        )
        for cost in costs
    )
    note = (
        "Means over captures and seeds; peak memory is the largest. Whole process: start-up, "
        "checkpoints and rendering included."
    )
    return Table("Times and memory", columns, rows, (note,))


def _front_table(front: Sequence[FrontPart], metric: str) -> Table:
    facts = metric_facts(metric)
    score = f"{facts.label} [{facts.unit}]" if facts.unit else facts.label
    columns = (
        Column("Best so far"),
        Column("From [s]", 1),
        Column("To [s]", 1),
        Column("From", facts.digits, group=score),
        Column("To", facts.digits, group=score),
    )
    rows = tuple((p.label, p.start, p.stop, p.first_score, p.last_score) for p in front)
    return Table("Pareto front", columns, rows, ("No method has as good a score in less time.",))


def machine_notes(results: Sequence[Results]) -> list[str]:
    """Return a warning where seconds were taken on different machines or devices."""
    machines = {
        f"{result.environment.get('processor', 'unknown')}, "
        f"{result.environment.get('cores', '?')} cores"
        for result in results
    }
    devices = {capture.device for result in results for capture in result.captures}
    notes = [f"Machine: {'; '.join(sorted(machines))}."]
    if len(machines) > 1 or len(devices - {None}) > 1:
        notes.append("Taken on different machines or devices: the seconds do not compare.")
    return notes
