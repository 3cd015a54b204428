"""Methods compared: paired differences with intervals, ranks, ties, who wins, and their tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from string import ascii_lowercase
from typing import Any, TypeVar

import numpy as np

from hwp_bench.analysis.bootstrap import RESAMPLES, Estimate, bootstrap_mean
from hwp_bench.analysis.columns import Filled, score_column, table_of
from hwp_bench.analysis.pairing import (
    MACRO,
    MethodRuns,
    common_metrics,
    common_seeds,
    group_runs,
    refuse_unlike,
    scopes,
)
from hwp_bench.base.errors import UsageError
from hwp_bench.base.tables import Column, Table, format_table
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.results import Results
from hwp_bench.taxonomy import PERTURBATIONS, perturbation

#: Level at which two methods differ significantly.
ALPHA = 0.05


@dataclass(frozen=True, kw_only=True)
class Contrast:
    """A difference of paired scores in one metric and scope."""

    #: Name of the metric.
    metric: str
    #: A scope of `analysis.pairing.scopes`.
    scope: str
    #: In the metric's unit.
    estimate: Estimate
    #: Probability that what is added makes the score better, in the metric's own direction.
    better: float | None
    #: p-value, adjusted over the perturbations for perturbations and over the pairs of methods
    #: for the macro mean; None where nothing is adjusted.
    p_adjusted: float | None = None


@dataclass(frozen=True, kw_only=True)
class Difference(Contrast):
    """One method less another in one scope."""

    #: Label of the first method.
    first: str
    #: Label of the second.
    second: str


_Contrast = TypeVar("_Contrast", bound=Contrast)


@dataclass(frozen=True)
class Standing:
    """Where one method stands among others."""

    #: Its label.
    label: str
    #: Mean in the macro scope, over seeds.
    mean: float
    #: Standard deviation of that mean over seeds; None with one seed.
    seed_deviation: float | None
    #: The seeds, rising.
    seeds: tuple[int, ...]
    #: Letters; two methods that share one do not differ significantly.
    ties: str


def compare(
    runs: Sequence[MethodRuns],
    metric: str,
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
    scope: str | None = None,
) -> list[Difference]:
    """Return the difference of every pair of methods in every scope.

    The runs must have passed `analysis.pairing.refuse_unlike`.

    Args:
        runs: at least two methods.
        scope: the only scope that is wanted; None takes all.
    """
    differences: list[Difference] = []
    for first, second in combinations(runs, 2):
        seeds = common_seeds(first, second)
        terms = ((1.0, first), (-1.0, second))
        differences += [
            Difference(first=first.label, second=second.label, **vars(item))
            for item in contrasts(terms, metric, seeds, resamples=resamples, seed=seed, only=scope)
        ]
    return _adjusted(differences, lambda found: found == MACRO)


def contrasts(
    terms: Sequence[tuple[float, MethodRuns]],
    metric: str,
    seeds: Sequence[int],
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
    only: str | None = None,
) -> list[Contrast]:
    """Return the sum of runs, each times its factor, in every scope or the only one wanted.

    p-values are adjusted over the perturbations.
    """
    found = []
    for scope, weights in scopes(terms[0][1].first).items():
        if only not in (None, scope):
            continue
        samples = [
            np.sum([factor * run.values(capture, metric, seeds) for factor, run in terms], axis=0)
            for capture in weights
        ]
        estimate = bootstrap_mean(samples, list(weights.values()), resamples=resamples, seed=seed)
        better = _surely(estimate, metric)
        found.append(Contrast(metric=metric, scope=scope, estimate=estimate, better=better))
    return _adjusted(found, lambda scope: scope in PERTURBATIONS)


def _surely(estimate: Estimate, metric: str) -> float | None:
    """Return the probability that the first method is better, in the metric's own direction."""
    if estimate.above is None or metric_facts(metric).higher_is_better:
        return estimate.above
    return 1 - estimate.above


def _adjusted(found: Sequence[_Contrast], in_family: Callable[[str], bool]) -> list[_Contrast]:
    """Put Holm's p-values of the family of some scopes into the list."""
    family = [item for item in found if in_family(item.scope) and item.estimate.p is not None]
    adjusted = iter(holm([item.estimate.p or 0.0 for item in family]))
    return [replace(item, p_adjusted=next(adjusted)) if item in family else item for item in found]


def standings(
    runs: Sequence[MethodRuns], metric: str, differences: Sequence[Difference]
) -> list[Standing]:
    """Return the methods, best first, with their tie groups."""
    sign = -1 if metric_facts(metric).higher_is_better else 1
    means = [(run, macro_by_seed(run, metric)) for run in runs]
    means.sort(key=lambda pair: sign * float(pair[1].mean()))
    places = {run.label: place for place, (run, _) in enumerate(means)}
    different = {}
    for item in differences:
        if item.scope == MACRO and item.metric == metric:
            low, high = sorted((places[item.first], places[item.second]))
            different[low, high] = item.p_adjusted is not None and item.p_adjusted < ALPHA
    return [
        Standing(
            run.label,
            float(mean.mean()),
            float(mean.std(ddof=1)) if len(mean) > 1 else None,
            tuple(sorted(run.seeds)),
            ties,
        )
        for (run, mean), ties in zip(means, tie_groups(len(means), different), strict=True)
    ]


def macro_by_seed(run: MethodRuns, metric: str) -> np.ndarray:
    """Return the macro mean of each seed, (S,) float."""
    weights = scopes(run.first)[MACRO]
    total = sum(weights.values())
    seeds = sorted(run.seeds)
    means = [
        weight * run.values(capture, metric, seeds).mean(axis=1)
        for capture, weight in weights.items()
    ]
    return np.sum(means, axis=0) / total


def macro_mean(run: MethodRuns, metric: str) -> float:
    """Return the macro mean, averaged over seeds."""
    return float(macro_by_seed(run, metric).mean())


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p-values so that the chance of any false finding stays at the level.

    Args:
        p_values: of the comparisons of one family, in any order.

    Returns:
        The adjusted values, in the same order, at most 1.

    Source: Holm, A simple sequentially rejective multiple test procedure, 1979.
    """
    values = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(values, kind="stable")
    factors = len(values) - np.arange(len(values))
    adjusted = np.empty(len(values))
    adjusted[order] = np.maximum.accumulate(np.minimum(1.0, factors * values[order]))
    return [float(value) for value in adjusted]


def tie_groups(count: int, different: Mapping[tuple[int, int], bool]) -> list[str]:
    """Return letters such that two items share one exactly where they do not differ.

    Args:
        count: number of items, best first.
        different: for each pair (i, j), i < j, whether the two differ.

    Returns:
        The letters of each item: `a`, `ab`, `b`, ...

    Source: insert and absorb, Piepho, An algorithm for a letter-based representation of all
    pairwise comparisons, 2004.
    """
    groups = [frozenset(range(count))]
    for first, second in sorted(pair for pair, differs in different.items() if differs):
        split: list[frozenset[int]] = []
        for group in groups:
            both = first in group and second in group
            split += [group - {first}, group - {second}] if both else [group]
        groups = [
            group
            for place, group in enumerate(split)
            if not any(
                group < other or (group == other and place > index)
                for index, other in enumerate(split)
            )
        ]
    groups.sort(key=sorted)
    # `a` to `z`, then `a1`, `b1`, ...
    letters = [f"{ascii_lowercase[place % 26]}{place // 26 or ''}" for place in range(len(groups))]
    named = list(zip(letters, groups, strict=True))
    return ["".join(letter for letter, group in named if item in group) for item in range(count)]


@dataclass(frozen=True)
class Rank:
    """The place of one method among others in one metric."""

    #: Its label, mean and tie group.
    standing: Standing
    #: 1 for the best mean; equal means share the smaller number.
    rank: int
    #: Best and worst rank that the data allow. Means are over all seeds and tests over common ones:
    #: where they contradict each other, the data allow the rank of the mean too.
    best: int
    worst: int
    #: Labels of the methods that it is significantly better than, and worse than.
    better_than: frozenset[str]
    worse_than: frozenset[str]
    #: This method less the leader; None for the leader itself.
    behind: Estimate | None

    @property
    def interval(self) -> str:
        """The ranks that the data allow in words: `1`, or `1 to 3`."""
        return f"{self.best}" if self.best == self.worst else f"{self.best} to {self.worst}"


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
    `ALPHA` / (m - 1); there are m - 1 such tests.) The tie groups hold for all pairs at once and
    claim less.
    """
    differences = compare(runs, metric, resamples=resamples, seed=seed, scope=MACRO)
    order = standings(runs, metric, differences)
    direction = 1 if metric_facts(metric).higher_is_better else -1
    # (first, second) -> first less second, and whether the first is significantly better (1) or
    # worse (-1), in both directions of a pair.
    leads: dict[tuple[str, str], Estimate] = {}
    signs: dict[tuple[str, str], int] = {}
    for item in differences:
        sign = direction * int(np.sign(item.estimate.value)) if _differs(item, len(runs)) else 0
        for pair, lead, turn in (
            ((item.first, item.second), item.estimate, sign),
            ((item.second, item.first), turned(item.estimate), -sign),
        ):
            leads[pair], signs[pair] = lead, turn
    ranks = []
    for own in order:
        better_than, worse_than = (
            frozenset(
                other.label
                for other in order
                if other is not own and signs[own.label, other.label] == sign
            )
            for sign in (1, -1)
        )
        rank = 1 + sum(direction * other.mean > direction * own.mean for other in order)
        ranks.append(
            Rank(
                own,
                rank,
                min(rank, 1 + len(worse_than)),
                max(rank, len(order) - len(better_than)),
                better_than,
                worse_than,
                leads[own.label, order[0].label] if own is not order[0] else None,
            )
        )
    return Ranking(metric, tuple(ranks), tuple(differences))


def _differs(item: Difference, methods: int) -> bool:
    """Whether a pair differs significantly, as one of the pairs that a method has with others."""
    return item.estimate.p is not None and item.estimate.p * (methods - 1) < ALPHA


def turned(estimate: Estimate) -> Estimate:
    """Return the estimate of second less first."""
    return replace(
        estimate,
        value=-estimate.value,
        low=None if estimate.high is None else -estimate.high,
        high=None if estimate.low is None else -estimate.low,
        above=None if estimate.above is None else 1 - estimate.above,
    )


def verdict(ranking: Ranking) -> str:
    """Return one sentence: who wins by how much and how surely, or who ties.

    A method wins where it is significantly better than every other one. Otherwise the methods that
    tie with the leader are named, and those that are better over the seeds that both have.
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
        surely = _surely(lead, ranking.metric)
        text += f" (95 % interval {ends}"
        text += f", P(better) {surely:.3f})" if surely is not None else ")"
    if first.standing.seeds != second.standing.seeds:
        text += " over the seeds that both have"
    if lead.captures == 1:
        text += ", on one capture, which speaks of no other"
    if first.worst == 1:
        return f"{first.standing.label} wins with {mean} (macro mean): {text}."
    if lead.low is None:
        return (
            f"{first.standing.label} leads with {mean} (macro mean): {text}; nothing says how sure."
        )
    label = first.standing.label
    others = [one.standing.label for one in rest]
    tied = [name for name in others if name not in first.better_than | first.worse_than]
    behind = [name for name in others if name in first.worse_than]
    found = []
    if behind:
        names = ", ".join(behind)
        found.append(f"is significantly behind {names} over the seeds that both have")
    if tied:
        found.append(f"is tied with {', '.join(tied)} (not significantly different")
        found[-1] += f", Bonferroni over the {len(rest)} pairs of the leader)" if rest[1:] else ")"
    return f"No clear winner: {label} leads with {mean} (macro mean), {text}, and " + (
        ", and ".join(found) + "."
    )


_INTERVAL = (
    "95 % intervals, P and p: paired bootstrap over captures, then seeds and blocks of frames, "
    "read with Student's t (docs/statistics.md)."
)
#: Said under a table that has such scopes.
ONE_CAPTURE = (
    "Scopes of one capture speak only of further frames of that capture, not of further captures."
)


def scope_title(scope: str) -> str:
    """Return the heading of a scope."""
    if scope in PERTURBATIONS:
        return perturbation(scope).heading
    return {MACRO: "Macro", "single": "Single", "interacting": "Interacting"}.get(scope, scope)


def contrast_columns(found: Sequence[Contrast], metric: str, better: str) -> list[Filled]:
    """Return the columns of scope, estimate and tests, with the unit and digits of a metric."""
    facts = metric_facts(metric)
    unit = f" [{facts.unit}]" if facts.unit else ""
    estimates = [item.estimate for item in found]
    return [
        (Column("Scope"), [scope_title(item.scope) for item in found]),
        (Column("Captures", 0), [one.captures for one in estimates]),
        (Column(f"Difference{unit}", facts.digits), [one.value for one in estimates]),
        (Column("Low", facts.digits, group="95 % interval"), [one.low for one in estimates]),
        (Column("High", facts.digits, group="95 % interval"), [one.high for one in estimates]),
        (Column(better, 3), [item.better for item in found]),
        (Column("p", 4), [one.p for one in estimates]),
        (Column("p (Holm)", 4), [item.p_adjusted for item in found]),
        (Column("Detectable", facts.digits), [one.detectable for one in estimates]),
    ]


def one_capture_notes(found: Sequence[Contrast]) -> list[str]:
    """Return the notes under a table that has scopes of one capture."""
    return [ONE_CAPTURE] if any(item.estimate.captures == 1 for item in found) else []


def standings_table(metric: str, found: Sequence[Standing]) -> Table:
    """Return one row per method, best first."""
    facts = metric_facts(metric)
    columns: list[Filled] = [
        (Column("Method"), [one.label for one in found]),
        (score_column(metric), [one.mean for one in found]),
        (Column("Ties"), [one.ties for one in found]),
        (Column("Seeds", 0), [len(one.seeds) for one in found]),
        (Column("Spread over seeds", facts.digits + 1), [one.seed_deviation for one in found]),
    ]
    note = (
        "Macro mean. Methods that share a letter do not differ significantly (Holm over the "
        "pairs, 5 %); the spread is the standard deviation of the mean over seeds."
    )
    return table_of(f"{facts.label}: methods", columns, [note])


def differences_table(metric: str, found: Sequence[Difference]) -> Table:
    """Return one row per pair and scope."""
    facts = metric_facts(metric)
    columns: list[Filled] = [
        (Column("First"), [item.first for item in found]),
        (Column("Second"), [item.second for item in found]),
        *contrast_columns(found, metric, "P(first better)"),
    ]
    direction = "above" if facts.higher_is_better else "below"
    notes = [
        f"First less second; {direction} 0 the first is better. {_INTERVAL}",
        "p (Holm): over the perturbations of a pair, and over the pairs for the macro mean. "
        "Detectable: the true difference that such a comparison finds with 80 % probability.",
        *one_capture_notes(found),
    ]
    return table_of(f"{facts.label}: differences", columns, notes)


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
        made = (
            (standings_table(name, found.methods), differences_table(name, found.differences))
            for name, found in self.metrics.items()
        )
        return [table for pair in made for table in pair]

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
    """Compare the methods of several results."""
    if not 100 <= resamples <= 1_000_000:
        raise UsageError(f"{resamples} is not between 100 and 1000000", field="--resamples")
    runs = group_runs(results)
    if len(runs) < 2:
        raise UsageError(
            "there is only one method to compare" if runs else "there is no result to compare",
            field="RESULTS",
            remedy="Results that differ only in the seed count as one method.",
        )
    refuse_unlike(runs)
    wanted = [metric_facts(name).name for name in metrics]
    names = common_metrics(runs, wanted)
    if not names or (all_metrics and len(names) < len(wanted)):
        raise UsageError("not every result has every metric asked for", field="--metric")
    found = {}
    for name in names:
        differences = compare(runs, name, resamples=resamples, seed=seed)
        found[name] = MetricComparison(standings(runs, name, differences), differences)
    return Comparison(found)
