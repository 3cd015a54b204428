"""Ranks of methods with intervals, and the sentence that says who wins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hwp_bench.analysis.statistics.bootstrap import RESAMPLES, Estimate
from hwp_bench.analysis.statistics.compare import ALPHA, Difference, Standing, compare, standings
from hwp_bench.analysis.statistics.pairing import MACRO, MethodRuns
from hwp_bench.metrics import metric as metric_facts


@dataclass(frozen=True)
class Rank:
    """The place of one method among others in one metric."""

    #: Its label, mean and tie group.
    standing: Standing
    #: 1 for the best mean; equal means share the smaller number.
    rank: int
    #: Best rank that the data allow.
    best: int
    #: Worst rank that the data allow.
    worst: int
    #: This method less the leader; None for the leader itself.
    behind: Estimate | None


@dataclass(frozen=True)
class Ranking:
    """Methods in order, and what is known of their order."""

    #: Name of the metric.
    metric: str
    #: The methods, best first.
    ranks: tuple[Rank, ...]
    #: The paired differences of the macro mean.
    differences: tuple[Difference, ...]


def rank_methods(
    runs: Sequence[MethodRuns], metric: str, *, resamples: int = RESAMPLES, seed: int = 0
) -> Ranking:
    """Rank methods by their macro mean.

    The interval of a rank goes from one more than the number of methods that are significantly
    better to the number of all less those that are significantly worse. Each method is tested
    against every other one, with Bonferroni's adjustment over these pairs: the interval of each
    method holds with 95 %, and so does the claim that the first is the best, although the data
    chose it. (A wrong claim needs that some method beats the truly best one in a test at
    `ALPHA` / (m - 1); there are m - 1 such tests.) The tie groups speak of all pairs at once and
    claim less.

    Args:
        runs: the methods, which must have passed `statistics.pairing.refuse_unlike`.
        metric: a metric that all have.
        resamples: of each interval.
        seed: of the resampling.

    Raises:
        UsageError: two methods have no seed in common.

    Source: Mogstad, Romano, Shaikh and Wilhelm, Inference for ranks with applications to mobility
    across neighbourhoods and academic achievement across countries, Review of Economic Studies
    91(1), 2024 (marginal confidence sets: the pairs of one population), in a single step.
    """
    differences = compare(runs, metric, resamples=resamples, seed=seed, scope=MACRO)
    order = standings(runs, metric, differences)
    higher = metric_facts(metric).higher_is_better
    # (first, second) -> first less second, in both directions of a pair.
    signs = {}
    leads = {}
    for item in differences:
        value = item.estimate.value if higher else -item.estimate.value
        differs = _differs(item, len(runs))
        signs[item.first, item.second] = (value > 0) - (value < 0) if differs else 0
        signs[item.second, item.first] = -signs[item.first, item.second]
        leads[item.first, item.second] = item.estimate
        leads[item.second, item.first] = turned(item.estimate)
    means = [place.mean if higher else -place.mean for place in order]
    ranks = []
    for own, mean in zip(order, means, strict=True):
        others = [other.label for other in order if other is not own]
        ranks.append(
            Rank(
                own,
                1 + sum(other > mean for other in means),
                1 + sum(signs[other, own.label] > 0 for other in others),
                len(order) - sum(signs[own.label, other] > 0 for other in others),
                leads[own.label, order[0].label] if own is not order[0] else None,
            )
        )
    return Ranking(metric, tuple(ranks), tuple(differences))


def _differs(item: Difference, methods: int) -> bool:
    """Whether a pair differs significantly, as one of the pairs that a method has with others."""
    return item.estimate.p is not None and item.estimate.p * (methods - 1) < ALPHA


def turned(estimate: Estimate) -> Estimate:
    """Return the estimate of second less first."""
    return Estimate(
        -estimate.value,
        None if estimate.high is None else -estimate.high,
        None if estimate.low is None else -estimate.low,
        None if estimate.above is None else 1 - estimate.above,
        estimate.p,
        estimate.detectable,
        estimate.captures,
    )


def verdict(ranking: Ranking) -> str:
    """Return one sentence: who wins by how much and how surely, or who ties.

    A method wins where it is significantly better than every other one. Otherwise those that the
    leader cannot be told from are named.
    """
    first, *rest = ranking.ranks
    facts = metric_facts(ranking.metric)
    unit = f" {facts.unit}" if facts.unit else ""
    mean = f"{facts.label} {first.standing.mean:.{facts.digits}f}{unit}"
    if not rest:
        return f"{first.standing.label} has {mean} (macro mean); nothing is compared with it."
    second = rest[0]
    assert second.behind is not None
    lead = turned(second.behind)
    text = f"{lead.value:+.{facts.digits}f}{unit} against {second.standing.label}, the next"
    if lead.low is not None and lead.high is not None:
        ends = f"{lead.low:+.{facts.digits}f} to {lead.high:+.{facts.digits}f}"
        surely = lead.above
        if surely is not None and not facts.higher_is_better:
            surely = 1 - surely
        text += f" (95 % interval {ends}"
        text += f", P(better) {surely:.3f})" if surely is not None else ")"
    if first.standing.seeds != second.standing.seeds:
        text += " over the seeds that both have"
    if lead.captures == 1:
        text += ", on one capture, which speaks of no other"
    tied = _tied_with(first.standing.label, ranking)
    if first.worst == 1:
        return f"{first.standing.label} wins with {mean} (macro mean): {text}."
    if lead.low is None:
        return (
            f"{first.standing.label} leads with {mean} (macro mean): {text}; nothing says how sure."
        )
    return (
        f"No clear winner: {first.standing.label} leads with {mean} (macro mean), {text}, and "
        f"is tied with {', '.join(tied)} (not significantly different"
        + (f", Bonferroni over the {len(rest)} pairs of the leader)." if rest[1:] else ").")
    )


def _tied_with(label: str, ranking: Ranking) -> list[str]:
    """Return the methods that one cannot be told from, best first."""
    found = {
        item.second if item.first == label else item.first
        for item in ranking.differences
        if label in (item.first, item.second) and not _differs(item, len(ranking.ranks))
    }
    return [item.standing.label for item in ranking.ranks if item.standing.label in found]
