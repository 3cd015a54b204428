"""How far the reference method is ahead of, or behind, its best competitor."""

from __future__ import annotations

from collections.abc import Sequence

from hwp_bench.analysis.statistics.compare import compare
from hwp_bench.analysis.statistics.pairing import MACRO, group_runs
from hwp_bench.base.errors import UsageError
from hwp_bench.leaderboard.board_rows import BoardRow
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.report.ranking_tables import METRIC

#: The method that every other one is measured against.
REFERENCE = "wildghand"


def reference_lead(rows: Sequence[BoardRow]) -> str:
    """Return one sentence: the reference against the best competitor with the same budget.

    Where the reference has rows of several budgets, the one with most competitors speaks.

    Args:
        rows: of one suite and one version of the protocol; those that lack a part of the suite do
            not take part.

    Returns:
        The sentence, whatever it says; empty where nobody has the budget of the reference, or no
        seed in common with it.
    """
    whole = [row for row in rows if row.whole]
    mine = [row for row in whole if row.first.method.name == REFERENCE]
    others = [row for row in whole if row.first.method.name != REFERENCE]
    pairs = [(row, [other for other in others if _equal_budget(row, other)]) for row in mine]
    reference, competitors = max(
        pairs, key=lambda pair: (len(pair[1]), pair[0].scores[METRIC]), default=(None, [])
    )
    if reference is None or not competitors:
        return ""
    best = max(competitors, key=lambda row: row.scores[METRIC])
    results = [one for row in (reference, best) for one in row.compared]
    try:
        (found,) = compare(group_runs(results), METRIC, scope=MACRO)
    except UsageError:
        return ""
    lead = found.estimate
    facts = metric_facts(METRIC)
    where = "ahead of" if lead.value >= 0.0 else "behind"
    text = (
        f"{reference.first.method.title} is {abs(lead.value):.{facts.digits}f} {facts.unit} "
        f"{where} {best.first.method.title}, the best other method "
        f"with the same budget on {reference.first.suite}"
    )
    if lead.low is None or lead.high is None:
        return f"{text}; nothing says how sure that is."
    text += f" (95 % interval {lead.low:+.{facts.digits}f} to {lead.high:+.{facts.digits}f}"
    return text + ("; not significant)." if lead.low <= 0.0 <= lead.high else ").")


def _equal_budget(one: BoardRow, other: BoardRow) -> bool:
    return one.first.budget == other.first.budget
