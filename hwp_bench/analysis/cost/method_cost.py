"""The cost of a method, from its curves and clocks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hwp_bench.analysis.cost.curves import Curve, curve_of
from hwp_bench.analysis.statistics.pairing import MethodRuns
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.results import CaptureResult
from hwp_bench.results.schema import per_second

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
