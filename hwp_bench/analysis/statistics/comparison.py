"""Compare results in several metrics: one record that the command and the Python API share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from hwp_bench.analysis.statistics.bootstrap import RESAMPLES
from hwp_bench.analysis.statistics.compare import Difference, Standing, compare, standings
from hwp_bench.analysis.statistics.comparison_tables import differences_table, standings_table
from hwp_bench.analysis.statistics.pairing import common_metrics, group_runs, refuse_unlike
from hwp_bench.base.errors import UsageError
from hwp_bench.base.tables import Table, format_table
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.results import Results


@dataclass(frozen=True)
class MetricComparison:
    """Methods compared in one metric."""

    #: The methods, best first.
    methods: list[Standing]
    #: Every pair of methods in every scope.
    differences: list[Difference]


@dataclass(frozen=True, repr=False)
class Comparison:
    """Methods compared in one metric or several; `print` shows its tables."""

    #: By metric, in the order asked for.
    metrics: dict[str, MetricComparison]

    def tables(self) -> list[Table]:
        """Return two tables for each metric: the methods, and their differences."""
        return [
            table
            for name, found in self.metrics.items()
            for table in (
                standings_table(name, found.methods),
                differences_table(name, found.differences),
            )
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers by metric, as JSON holds them."""
        return {name: asdict(found) for name, found in self.metrics.items()}

    def __repr__(self) -> str:
        labels = [item.label for found in self.metrics.values() for item in found.methods]
        return f"Comparison({', '.join(dict.fromkeys(labels))}; {', '.join(self.metrics)})"

    def __str__(self) -> str:
        return "\n".join(format_table(table, "md") for table in self.tables())

    def _repr_markdown_(self) -> str:
        return str(self)


def compare_results(
    results: Sequence[Results],
    metrics: Sequence[str],
    *,
    all_metrics: bool = False,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Comparison:
    """Compare the methods of several results.

    Args:
        results: of at least two methods on the same captures; results that differ only in the
            seed count as one method.
        metrics: names of metrics; one that not every result has is left out.
        all_metrics: refuse a metric that not every result has.
        resamples: bootstrap resamples of each interval, 100 to 1,000,000.
        seed: seed of the resampling.

    Raises:
        UsageError: the results are of one method only or of different data, no metric is left,
            or the number of resamples is out of range.
    """
    if not 100 <= resamples <= 1_000_000:
        raise UsageError(f"{resamples} is not between 100 and 1000000", field="--resamples")
    runs = group_runs(results)
    refuse_unlike(runs)
    if len(runs) < 2:
        raise UsageError(
            "there is only one method to compare",
            field="RESULTS",
            remedy="Results that differ only in the seed count as one method.",
        )
    wanted = [metric_facts(name).name for name in metrics]
    names = common_metrics(runs, wanted)
    if not names or (all_metrics and len(names) < len(wanted)):
        raise UsageError("not every result has every metric asked for", field="--metric")
    found = {}
    for name in names:
        differences = compare(runs, name, resamples=resamples, seed=seed)
        found[name] = MetricComparison(standings(runs, name, differences), differences)
    return Comparison(found)
