"""What a score costs: accuracy against time, seconds and memory of methods, and their tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hwp_bench.analysis.curves import (
    Curve,
    FrontPart,
    MeanCurve,
    curve_of,
    mean_curve,
    pareto_front,
)
from hwp_bench.analysis.pairing import MethodRuns, refuse_unlike
from hwp_bench.base.errors import UsageError
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.results import CaptureResult, Results
from hwp_bench.results.schema import isolation_note, per_second

#: Fixed budgets, s.
BUDGETS = (5.0, 15.0, 60.0, 300.0)
#: Distances to the own final score, in dB.
NEAR = (0.1, 0.5)


@dataclass(frozen=True)
class Reach:
    """How long it takes to get somewhere."""

    #: Median over fits, s; None where fewer than half get there.
    seconds: float | None
    #: Fits that get there.
    reached: int
    #: Fits with a curve.
    fits: int


@dataclass(frozen=True)
class MethodCost:
    """Accuracy against time of one method; means are over fits (captures and seeds)."""

    #: Its label.
    label: str
    #: Name of the metric of the scores.
    metric: str
    #: Mean final score on the validation frames; None without curves.
    final: float | None
    #: Mean score by budget in seconds; None before every fit has had a checkpoint.
    at: Mapping[float, float | None]
    #: Time to the reference's final score on the same capture; None without a reference.
    to_reference: Reach | None
    #: Time to within so many dB of the own final score; empty for metrics without a unit.
    to_own: Mapping[float, Reach]
    #: Mean score over log time in the window of all methods compared; None without one.
    area: float | None
    #: Seconds of fitting.
    fit_seconds: float | None
    #: CPU seconds of fitting, all threads added up; None where a result does not record it.
    cpu_seconds: float | None
    #: Optimizer steps.
    steps: float | None
    #: Seconds to render one frame.
    render_seconds: float | None
    #: Seconds to score one frame.
    score_seconds: float
    #: Seconds of the whole process, start-up and checkpoints included.
    wall_seconds: float
    #: Largest peak memory, bytes.
    peak_memory: int | None
    #: Devices that the method says it ran on.
    devices: tuple[str, ...]
    #: Fits that left a curve.
    curves: int
    #: Fits.
    fits: int

    @property
    def frames_per_second(self) -> float | None:
        """Frames rendered in a second."""
        return per_second(1, self.render_seconds)


def method_curves(run: MethodRuns, metric: str) -> dict[str, list[Curve]]:
    """Return the curves of every seed, by capture; captures without any are left out."""
    found: dict[str, list[Curve]] = {}
    for _, results in sorted(run.seeds.items()):
        for capture in results.captures:
            curve = curve_of(capture, metric)
            if curve is not None:
                found.setdefault(capture.id, []).append(curve)
    return found


def window(curves: Sequence[Mapping[str, Sequence[Curve]]]) -> tuple[float, float] | None:
    """Return the seconds over which all methods can be compared.

    From the moment when every fit of every method has had a checkpoint to the end of the longest
    fit (one that ended earlier keeps its score). None where that leaves no time.
    """
    every = [curve for method in curves for fits in method.values() for curve in fits]
    if not every:
        return None
    start = max(float(curve.seconds[0]) for curve in every)
    stop = max(float(curve.seconds[-1]) for curve in every)
    return (start, stop) if stop > start else None


def method_costs(
    runs: Sequence[MethodRuns],
    metric: str,
    *,
    budgets: Sequence[float] = BUDGETS,
    reference: MethodRuns | None = None,
) -> list[MethodCost]:
    """Return the cost of every method.

    Args:
        runs: the methods.
        metric: a metric of the curves.
        budgets: seconds at which scores are read; those that no fit lasted for are left out.
        reference: the method whose final scores are a target.
    """
    curves = [method_curves(run, metric) for run in runs]
    stretch = window(curves)
    longest = max(
        (float(c.seconds[-1]) for method in curves for fits in method.values() for c in fits),
        default=0.0,
    )
    reached = [budget for budget in budgets if budget <= longest]
    targets = (
        {name: float(np.mean([c.final for c in fits])) for name, fits in known.items()}
        if reference is not None and (known := method_curves(reference, metric))
        else None
    )
    return [
        _method_cost(run, metric, method, reached, targets, stretch)
        for run, method in zip(runs, curves, strict=True)
    ]


def _method_cost(
    run: MethodRuns,
    metric: str,
    curves: Mapping[str, Sequence[Curve]],
    budgets: Sequence[float],
    targets: Mapping[str, float] | None,
    stretch: tuple[float, float] | None,
) -> MethodCost:
    facts = metric_facts(metric)
    higher = facts.higher_is_better
    every = [curve for fits in curves.values() for curve in fits]
    captures = [capture for results in run.seeds.values() for capture in results.captures]
    to_reference = None
    if targets is not None:
        times = [
            c.time_to(targets[n], higher) for n, f in curves.items() if n in targets for c in f
        ]
        to_reference = _reach(times)
    signs = -1 if higher else 1
    near = NEAR if facts.unit == "dB" else ()
    frames = sum(len(capture.frames) for capture in captures)
    return MethodCost(
        label=run.label,
        metric=metric,
        final=_mean([curve.final for curve in every]),
        at={budget: _mean([float(c.at(budget)) for c in every]) for budget in budgets},
        to_reference=to_reference,
        to_own={
            step: _reach([c.time_to(c.final + signs * step, higher) for c in every])
            for step in near
        },
        area=_mean([curve.log_area(*stretch) for curve in every]) if stretch else None,
        fit_seconds=_mean([c.fit_seconds for c in captures if c.fit_seconds is not None]),
        cpu_seconds=_mean([c.cpu_seconds for c in captures if c.cpu_seconds is not None]),
        steps=_mean([float(c.steps) for c in captures if c.steps is not None]),
        render_seconds=_render_seconds(captures),
        score_seconds=sum(capture.score_seconds for capture in captures) / max(frames, 1),
        wall_seconds=_mean([capture.wall_seconds for capture in captures]) or 0.0,
        peak_memory=max(
            (c.peak_memory for c in captures if c.peak_memory is not None), default=None
        ),
        devices=tuple(sorted({c.device for c in captures if c.device})),
        curves=len(every),
        fits=len(captures),
    )


def _mean(values: Sequence[float]) -> float | None:
    mean = float(np.mean(values)) if values else math.nan
    return mean if math.isfinite(mean) else None


def _reach(times: Sequence[float]) -> Reach:
    # The lower median, so that half of the fits are enough.
    median = sorted(times)[(len(times) - 1) // 2] if times else math.inf
    count = sum(math.isfinite(time) for time in times)
    return Reach(median if math.isfinite(median) else None, count, len(times))


def _render_seconds(captures: Sequence[CaptureResult]) -> float | None:
    timed = [(c.render_seconds, len(c.frames)) for c in captures if c.render_seconds]
    return sum(spent for spent, _ in timed) / sum(n for _, n in timed) if timed else None


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


#: Name of the plain baseline, the reference where it is among the methods.
PLAIN = "plain"


@dataclass(frozen=True)
class CostAnalysis:
    """Accuracy against time of several methods."""

    #: Name of the metric.
    metric: str
    #: One entry a method.
    costs: tuple[MethodCost, ...]
    #: Mean curves of those methods that have any.
    curves: tuple[MeanCurve, ...]
    #: Which method has the best score when.
    front: tuple[FrontPart, ...]
    #: The tables by name.
    tables: Mapping[str, Table]

    def as_object(self) -> dict[str, Any]:
        """Return plain JSON data."""
        curves = [
            {
                "label": curve.label,
                "seconds": curve.seconds.tolist(),
                "scores": curve.scores.tolist(),
                "low": None if curve.low is None else curve.low.tolist(),
                "high": None if curve.high is None else curve.high.tolist(),
            }
            for curve in self.curves
        ]
        return {
            "metric": self.metric,
            "methods": [
                {**asdict(cost), "frames_per_second": cost.frames_per_second} for cost in self.costs
            ],
            "curves": curves,
            "front": [asdict(part) for part in self.front],
        }


def analyse_cost(
    runs: Sequence[MethodRuns],
    metric: str,
    *,
    budgets: Sequence[float] = BUDGETS,
    reference: MethodRuns | None = None,
) -> CostAnalysis:
    """Analyse accuracy against time.

    Args:
        runs: the methods; at least one.
        metric: a metric of the curves.
        budgets: seconds at which scores are read.
        reference: the method whose final score is a target; None takes the plain baseline where
            it is among `runs`.

    Raises:
        UsageError: the runs (the reference's included) are on different data, splits, protocols
            or training frames; or none left a curve in this metric.
    """
    if reference is None:
        plain = [run for run in runs if run.first.method.name == PLAIN]
        reference = plain[0] if plain else None
    refuse_unlike([*runs, *([reference] if reference else [])])
    methods = [method_curves(run, metric) for run in runs]
    curves = [
        curve
        for run, method in zip(runs, methods, strict=True)
        if (curve := mean_curve(run.label, method)) is not None
    ]
    if not curves:
        raise UsageError(
            f"no result has a curve of {metric}",
            field="metric",
            remedy="Methods leave curves by calling `report` while they fit (docs/methods.md).",
        )
    costs = method_costs(runs, metric, budgets=budgets, reference=reference)
    front = pareto_front(curves, metric_facts(metric).higher_is_better)
    tables = cost_tables(
        costs,
        front,
        metric,
        reference=reference.label if reference else None,
        stretch=window(methods),
        notes=machine_notes([result for run in runs for result in run.seeds.values()]),
    )
    seconds = seconds_table(runs)
    if seconds is not None:
        tables["seconds"] = seconds
    return CostAnalysis(metric, tuple(costs), tuple(curves), tuple(front), tables)
