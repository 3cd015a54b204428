"""From results to accuracy against time: costs, curves, the front and their tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from hwp_bench.analysis.cost.cost_tables import cost_tables, machine_notes, seconds_table
from hwp_bench.analysis.cost.curves import FrontPart, MeanCurve, mean_curve, pareto_front
from hwp_bench.analysis.cost.method_cost import (
    BUDGETS,
    MethodCost,
    method_costs,
    method_curves,
    window,
)
from hwp_bench.analysis.statistics.pairing import MethodRuns, refuse_unlike
from hwp_bench.base.errors import UsageError
from hwp_bench.base.tables import Table
from hwp_bench.metrics import metric as metric_facts

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
