"""The cost of a score: accuracy against time, seconds and memory of methods, and their tables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hwp_bench.analysis.columns import Filled, score_title, table_of
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
from hwp_bench.base.tables import Column, Table
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

    @property
    def peak_gb(self) -> float | None:
        """Largest peak memory, GB."""
        return self.peak_memory / 1e9 if self.peak_memory else None


def method_curves(run: MethodRuns, metric: str) -> dict[str, list[Curve]]:
    """Return the curves of every seed, by capture; captures without any are left out."""
    found: dict[str, list[Curve]] = {}
    for _, results in sorted(run.seeds.items()):
        for capture in results.captures:
            if (curve := curve_of(capture, metric)) is not None:
                found.setdefault(capture.id, []).append(curve)
    return found


def window(curves: Iterable[Mapping[str, Sequence[Curve]]]) -> tuple[float, float] | None:
    """Return the seconds over which all methods can be compared.

    From the moment when every fit of every method has had a checkpoint to the end of the longest
    fit (one that ended earlier keeps its score). None where that leaves no time.
    """
    every = [curve for method in curves for fits in method.values() for curve in fits]
    start = max((float(curve.seconds[0]) for curve in every), default=0.0)
    stop = max((float(curve.seconds[-1]) for curve in every), default=0.0)
    return (start, stop) if stop > start else None


def method_costs(
    runs: Sequence[MethodRuns],
    metric: str,
    budgets: Sequence[float] = BUDGETS,
    reference: MethodRuns | None = None,
) -> list[MethodCost]:
    """Return the cost of every method; of the budgets those that a fit reaches."""
    facts = metric_facts(metric)
    higher = facts.higher_is_better
    methods = [method_curves(run, metric) for run in runs]
    stretch = window(methods)
    longest = max(
        (c.seconds[-1] for own in methods for fits in own.values() for c in fits), default=0
    )
    known = method_curves(reference, metric) if reference is not None else {}
    targets = {name: float(np.mean([c.final for c in fits])) for name, fits in known.items()}
    costs = []
    for run, own in zip(runs, methods, strict=True):
        every = [curve for fits in own.values() for curve in fits]
        captures = [capture for results in run.seeds.values() for capture in results.captures]
        timed = [capture for capture in captures if capture.render_seconds]
        near = {
            step: [c.time_to(c.final + (-step if higher else step), higher) for c in every]
            for step in (NEAR if facts.unit == "dB" else ())
        }
        there = [
            c.time_to(targets[name], higher)
            for name, fits in own.items()
            if name in targets
            for c in fits
        ]
        costs.append(
            MethodCost(
                label=run.label,
                metric=metric,
                final=_mean([curve.final for curve in every]),
                at={b: _mean([float(c.at(b)) for c in every]) for b in budgets if b <= longest},
                to_reference=_reach(there) if targets else None,
                to_own={step: _reach(times) for step, times in near.items()},
                area=_mean([curve.log_area(*stretch) for curve in every]) if stretch else None,
                fit_seconds=_mean([c.fit_seconds for c in captures]),
                cpu_seconds=_mean([c.cpu_seconds for c in captures]),
                steps=_mean([c.steps for c in captures]),
                render_seconds=_per_frame([c.render_seconds or 0.0 for c in timed], timed),
                score_seconds=_per_frame([c.score_seconds for c in captures], captures) or 0.0,
                wall_seconds=_mean([capture.wall_seconds for capture in captures]) or 0.0,
                peak_memory=max((c.peak_memory or 0 for c in captures), default=0) or None,
                devices=tuple(sorted({c.device for c in captures if c.device})),
                curves=len(every),
                fits=len(captures),
            )
        )
    return costs


def _mean(values: Iterable[float | None]) -> float | None:
    """The mean of what is known; None where nothing is, or the mean is not finite."""
    known = [value for value in values if value is not None]
    mean = float(np.mean(known)) if known else math.nan
    return mean if math.isfinite(mean) else None


def _reach(times: Sequence[float]) -> Reach:
    # The lower median, so that half of the fits are enough.
    median = sorted(times)[(len(times) - 1) // 2] if times else math.inf
    count = sum(math.isfinite(time) for time in times)
    return Reach(median if math.isfinite(median) else None, count, len(times))


def _per_frame(seconds: Sequence[float], captures: Sequence[CaptureResult]) -> float | None:
    frames = sum(len(capture.frames) for capture in captures)
    return sum(seconds) / frames if frames else None


#: The parts of a run, in the order of time, with what they hold.
PARTS: Mapping[str, str] = {
    "start": "the method's process begins, imports, compiles, reads; at its end it writes",
    "fit": "the method's clock",
    "curve": "checkpoints are rendered, the method's clock stands still",
    "render": "the test frames are rendered",
    "score": "the benchmark copies the request, checks, scores, draws images",
}


def _cost_table(
    costs: Sequence[MethodCost],
    metric: str,
    reference: str | None,
    stretch: tuple[float, float] | None,
    notes: Sequence[str],
) -> Table:
    facts, score = metric_facts(metric), score_title(metric)

    def scored(title: str, group: str) -> Column:
        return Column(title, facts.digits, facts.higher_is_better, group)

    columns: list[Filled] = [
        (Column("Method"), [cost.label for cost in costs]),
        *(
            (scored(f"{budget:g} s", f"{score} after"), [cost.at[budget] for cost in costs])
            for budget in costs[0].at
        ),
        (scored("Final", score), [cost.final for cost in costs]),
    ]
    if stretch:
        columns.append((scored("Mean over log time", score), [cost.area for cost in costs]))
    if reference is not None:
        reach = [cost.to_reference for cost in costs]
        counts = [f"{one.reached} of {one.fits}" if one else None for one in reach]
        head = Column(f"To final of {reference}", 1, False, "Seconds")
        columns.append((head, [one.seconds if one else None for one in reach]))
        columns.append((Column("Fits that get there"), counts))
    for step in costs[0].to_own:
        head = Column(f"To own final within {step:g} dB", 1, False, "Seconds")
        columns.append((head, [cost.to_own[step].seconds for cost in costs]))
    text = [
        "Scores on validation frames, outside the method's clock; means over captures and seeds, "
        "linear in the log of time between checkpoints. A fit that has ended keeps its score.",
        "Seconds to a score: median over fits; none where fewer than half get there.",
    ]
    if stretch:
        text.append(f"Mean over log time: from {stretch[0]:.3g} to {stretch[1]:.3g} s.")
    return table_of("Accuracy against time", columns, [*text, *notes])


def _times_table(costs: Sequence[MethodCost]) -> Table:
    columns: list[Filled] = [
        (Column("Method"), [cost.label for cost in costs]),
        (Column("Fit [s]", 1), [cost.fit_seconds for cost in costs]),
        (Column("On one core [s]", 1), [cost.cpu_seconds for cost in costs]),
        (Column("Steps", 0), [cost.steps for cost in costs]),
        (Column("Step [ms]", 1), [_ms(cost.fit_seconds, cost.steps) for cost in costs]),
        (Column("Render [ms/frame]", 1), [_ms(cost.render_seconds) for cost in costs]),
        (Column("Render [frames/s]", 1), [cost.frames_per_second for cost in costs]),
        (Column("Score [ms/frame]", 1), [1000 * cost.score_seconds for cost in costs]),
        (Column("Whole process [s]", 1), [cost.wall_seconds for cost in costs]),
        (Column("Peak memory [GB]", 2), [cost.peak_gb for cost in costs]),
        (Column("Device"), [", ".join(cost.devices) or None for cost in costs]),
    ]
    note = (
        "Means over captures and seeds; peak memory is the largest. Whole process: start-up, "
        "checkpoints and rendering included. On one core: CPU seconds of the fit, all threads."
    )
    return table_of("Times and memory", columns, [note])


def _ms(seconds: float | None, count: float | None = 1.0) -> float | None:
    return 1000 * seconds / count if seconds and count else None


def _front_table(front: Sequence[FrontPart], metric: str) -> Table:
    digits, score = metric_facts(metric).digits, score_title(metric)
    columns: list[Filled] = [
        (Column("Best so far"), [part.label for part in front]),
        (Column("From [s]", 1), [part.start for part in front]),
        (Column("To [s]", 1), [part.stop for part in front]),
        (Column("From", digits, group=score), [part.first_score for part in front]),
        (Column("To", digits, group=score), [part.last_score for part in front]),
    ]
    note = "No method has as good a score in less time."
    return table_of("Pareto front", columns, [note])


def _lost_notes(costs: Sequence[MethodCost]) -> list[str]:
    lost = [f"{cost.label}: {cost.fits - cost.curves}" for cost in costs if cost.curves < cost.fits]
    return [f"Fits without a curve, left out: {'; '.join(lost)}."] if lost else []


def machine_notes(results: Sequence[Results]) -> list[str]:
    """Return the machines, with warnings: several of them, or runs without a sandbox."""
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
    """Return the seconds of one run by part; None where it failed, or they are not on record."""
    if capture.failure or capture.job_seconds is None or not capture.wall_seconds:
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
    """Return one row per part of the runs, and their sum; None where nothing is on record."""
    results = [result for run in runs for result in run.seeds.values()]
    every = [run_seconds(capture) for result in results for capture in result.captures]
    known = [parts for parts in every if parts is not None]
    whole = sum(sum(parts.values()) for parts in known)
    if not whole:
        return None
    spent = [*(sum(parts[name] for parts in known) for name in PARTS), whole]
    columns: list[Filled] = [
        (Column("Part"), [*PARTS, "sum"]),
        (Column("Mean of a run [s]", 2), [seconds / len(known) for seconds in spent]),
        (Column("All runs [s]", 1), spent),
        (Column("Share [%]", 1), [100 * seconds / whole for seconds in spent]),
        (Column("What it is"), [*PARTS.values(), f"{len(known)} runs"]),
    ]
    notes = ["A run is one fit of one capture; runs that go side by side are added up."]
    if len(known) < len(every):
        notes.append(f"{len(every) - len(known)} of {len(every)} runs do not record it.")
    return table_of("Where the seconds go", columns, notes, breaks=(len(PARTS),))


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
    #: What the numbers lack or mix: fits without a curve, machines, runs without a sandbox.
    notes: tuple[str, ...]

    def as_object(self) -> dict[str, Any]:
        """Return plain JSON data."""
        return {
            "metric": self.metric,
            "methods": [
                {**asdict(cost), "frames_per_second": cost.frames_per_second} for cost in self.costs
            ],
            "curves": [
                {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(curve).items()}
                for curve in self.curves
            ],
            "front": [asdict(part) for part in self.front],
        }


def analyse_cost(
    runs: Sequence[MethodRuns],
    metric: str,
    budgets: Sequence[float] = BUDGETS,
    reference: MethodRuns | None = None,
) -> CostAnalysis:
    """Analyse accuracy against time; tables `cost`, `times`, `front`, and `seconds` where known."""
    if reference is None:
        reference = next((run for run in runs if run.first.method.name == PLAIN), None)
    refuse_unlike([*runs, *([reference] if reference else [])])
    methods = [method_curves(run, metric) for run in runs]
    named = zip(runs, methods, strict=True)
    curves = [curve for run, own in named if (curve := mean_curve(run.label, own)) is not None]
    if not curves:
        raise UsageError(
            f"no result has a curve of {metric}",
            field="metric",
            remedy="Methods leave curves by calling `report` while they fit (docs/methods.md).",
        )
    costs = method_costs(runs, metric, budgets, reference)
    front = pareto_front(curves, metric_facts(metric).higher_is_better)
    results = [result for run in runs for result in run.seeds.values()]
    notes = (*_lost_notes(costs), *machine_notes(results))
    label = reference.label if reference else None
    tables = {
        "cost": _cost_table(costs, metric, label, window(methods), notes),
        "times": _times_table(costs),
        "front": _front_table(front, metric),
    }
    if (seconds := seconds_table(runs)) is not None:
        tables["seconds"] = seconds
    return CostAnalysis(metric, tuple(costs), tuple(curves), tuple(front), tables, notes)
