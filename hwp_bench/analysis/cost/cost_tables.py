"""The tables of cost: accuracy against time, and where the seconds of runs go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hwp_bench.analysis.cost.curves import FrontPart
from hwp_bench.analysis.cost.method_cost import MethodCost, Reach
from hwp_bench.analysis.statistics.pairing import MethodRuns
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.results import CaptureResult, Results
from hwp_bench.results.schema import isolation_note

#: The parts of a run, in the order of time, with what they hold.
PARTS: Mapping[str, str] = {
    "start": "the method's process begins, imports, compiles, reads; at its end it writes",
    "fit": "the method's clock",
    "curve": "checkpoints are rendered, the method's clock stands still",
    "render": "the test frames are rendered",
    "score": "the benchmark copies the request, checks, scores, draws images",
}

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
        Column("On one core [s]", 1),
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
            cost.cpu_seconds,
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
        "checkpoints and rendering included. On one core: CPU seconds of the fit, all threads."
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
    """Return the machines, with warnings: several of them, or methods that ran without walls."""
    machines = {
        f"{result.environment.get('processor', 'unknown')}, "
        f"{result.environment.get('cores', '?')} cores"
        for result in results
    }
    devices = {capture.device for result in results for capture in result.captures}
    notes = [f"Machine: {'; '.join(sorted(machines))}."]
    if len(machines) > 1 or len(devices - {None}) > 1:
        notes.append("Taken on different machines or devices: the seconds do not compare.")
    walls = isolation_note(results)
    return [*notes, walls] if walls else notes


def run_seconds(capture: CaptureResult) -> dict[str, float] | None:
    """Return the seconds of one run by part; None where they were not put on record.

    Args:
        capture: the result of the run.

    Returns:
        Keys are those of `PARTS`. What a method does not say of itself is part of its start.
    """
    if capture.job_seconds is None or not capture.wall_seconds:
        return None
    said = {
        "fit": capture.fit_seconds or 0.0,
        "curve": capture.curve_seconds or 0.0,
        "render": capture.render_seconds or 0.0,
    }
    # A method that claims more than its process took cannot make the rest negative.
    start = max(capture.wall_seconds - sum(said.values()), 0.0)
    return {"start": start, **said, "score": max(capture.job_seconds - capture.wall_seconds, 0.0)}


def seconds_table(runs: Sequence[MethodRuns]) -> Table | None:
    """Return one row a part of the runs, and their sum; None where nothing is on record."""
    every = [
        run_seconds(capture)
        for run in runs
        for result in run.seeds.values()
        for capture in result.captures
    ]
    known = [parts for parts in every if parts is not None]
    whole = sum(sum(parts.values()) for parts in known)
    if not whole:
        return None
    columns = (
        Column("Part"),
        Column("Mean of a run [s]", 2),
        Column("All runs [s]", 1),
        Column("Share [%]", 1),
        Column("What it is"),
    )
    sums = {name: sum(parts[name] for parts in known) for name in PARTS}
    rows = [
        (name, spent / len(known), spent, 100 * spent / whole, PARTS[name])
        for name, spent in sums.items()
    ]
    rows.append(("sum", whole / len(known), whole, 100.0, f"{len(known)} runs"))
    notes = ["A run is one fit of one capture; runs that go side by side are added up."]
    if len(known) < len(every):
        notes.append(f"{len(every) - len(known)} of {len(every)} runs do not record it.")
    return Table("Where the seconds go", columns, tuple(rows), tuple(notes), breaks=(len(PARTS),))
