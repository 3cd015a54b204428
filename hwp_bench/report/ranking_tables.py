"""Tables that rank methods: by score with intervals, and by what the score costs."""

from __future__ import annotations

from collections.abc import Sequence

from hwp_bench.analysis.cost.method_cost import BUDGETS, MethodCost, method_costs
from hwp_bench.analysis.statistics.compare import macro_by_seed
from hwp_bench.analysis.statistics.pairing import MethodRuns, common_metrics, group_runs
from hwp_bench.analysis.statistics.ranks import rank_methods, verdict
from hwp_bench.base.errors import UsageError
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.report.evaluation_tables import HEADLINE, score_column
from hwp_bench.results import Results

#: Metric of the ranks and of the sentence that says who wins.
METRIC = HEADLINE[0]
_GB = 1e9


def rank_table(runs: Sequence[MethodRuns]) -> Table:
    """Return one row a method, best first: rank with interval, score, what it is behind, ties.

    Args:
        runs: the methods, on the same data.

    Raises:
        UsageError: two methods have no seed in common.
    """
    ranking = rank_methods(runs, METRIC)
    facts = metric_facts(METRIC)
    others = [name for name in common_metrics(runs, HEADLINE) if name != METRIC]
    by_label = {run.label: run for run in runs}
    columns = [
        Column("Method"),
        Column("Rank", 0, group="Rank"),
        Column("95 %", group="Rank"),
        score_column(METRIC),
        Column("Difference", facts.digits, group="Less the first"),
        Column("Low", facts.digits, group="Less the first"),
        Column("High", facts.digits, group="Less the first"),
        Column("Ties"),
        *(score_column(name) for name in others),
        Column("Seeds", 0),
    ]
    rows: list[tuple[Cell, ...]] = []
    for item in ranking.ranks:
        behind = item.behind
        rows.append(
            (
                item.standing.label,
                item.rank,
                f"{item.best}" if item.best == item.worst else f"{item.best} to {item.worst}",
                item.standing.mean,
                *((behind.value, behind.low, behind.high) if behind else (None, None, None)),
                item.standing.ties,
                *(float(macro_by_seed(by_label[item.standing.label], n).mean()) for n in others),
                item.standing.seeds,
            )
        )
    notes = (
        verdict(ranking),
        "Macro means. Interval of a rank: what a method's significant differences leave "
        "(Bonferroni over its pairs), so that each interval holds with 95 %. Methods that share "
        "a letter are tied (Holm over all pairs).",
    )
    return Table(f"Ranks by {facts.label}", tuple(columns), tuple(rows), notes)


def winner_note(results: Sequence[Results]) -> str | None:
    """Return the sentence that says who wins; None where there is nothing to compare.

    Args:
        results: on the same data.
    """
    try:
        runs = group_runs(results)
        if len(runs) < 2 or not common_metrics(runs, [METRIC]):
            return None
        return verdict(rank_methods(runs, METRIC))
    except UsageError as error:
        # The same run twice, or no seed in common: the tables can be shown all the same.
        return f"Nobody is named as the winner: {error.problem}."


def cost_table(runs: Sequence[MethodRuns]) -> Table:
    """Return one row a method: its score, the score after fixed times, seconds and memory.

    Args:
        runs: the methods, on the same data.
    """
    facts = metric_facts(METRIC)
    costs = method_costs(runs, METRIC, budgets=BUDGETS)
    scores = [float(macro_by_seed(run, METRIC).mean()) for run in runs]
    budgets = list(costs[0].at)
    unit = f"{facts.label} [{facts.unit}]"
    columns = [
        Column("Method"),
        Column("Test", facts.digits, True, unit),
        *(Column(f"{budget:g} s", facts.digits, True, f"{unit} after") for budget in budgets),
        Column("Fit [s]", 1, False, "Cost"),
        Column("One core [s]", 1, False, "Cost"),
        Column("Memory [GB]", 2, False, "Cost"),
        Column("Render [frames/s]", 1, True, "Cost"),
        Column("Front"),
    ]
    rows = [
        (
            cost.label,
            score,
            *(cost.at[budget] for budget in budgets),
            cost.fit_seconds,
            cost.cpu_seconds,
            cost.peak_memory / _GB if cost.peak_memory else None,
            cost.frames_per_second,
            "yes" if on_front(cost, score, costs, scores) else None,
        )
        for cost, score in zip(costs, scores, strict=True)
    ]
    notes = (
        "Test: macro mean. After a time: validation frames, outside the method's clock. One core: "
        "CPU seconds of the fit, all threads added up; the seconds that one core would need.",
        "Front: no other method has at least this test score in as few seconds. Means over "
        "captures and seeds; memory is the largest. Seconds compare on one machine only.",
    )
    return Table("Accuracy and cost", tuple(columns), tuple(rows), notes)


def on_front(
    cost: MethodCost, score: float, costs: Sequence[MethodCost], scores: Sequence[float]
) -> bool:
    """Return whether no other method is at least as good in as few seconds, and better in one.

    Args:
        cost: of the method.
        score: its test score, larger is better.
        costs: of all methods.
        scores: their test scores.
    """
    if cost.fit_seconds is None:
        return False
    for other, theirs in zip(costs, scores, strict=True):
        if other is cost or other.fit_seconds is None:
            continue
        as_good = theirs >= score and other.fit_seconds <= cost.fit_seconds
        if as_good and (theirs > score or other.fit_seconds < cost.fit_seconds):
            return False
    return True
