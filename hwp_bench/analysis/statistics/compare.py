"""Compare methods: paired differences by scope, Holm over perturbations, tie groups."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from hwp_bench.analysis.statistics.bootstrap import RESAMPLES, Estimate, bootstrap_mean
from hwp_bench.analysis.statistics.pairing import MACRO, MethodRuns, common_seeds, scopes
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.taxonomy import PERTURBATIONS

#: Level at which two methods differ significantly.
ALPHA = 0.05


@dataclass(frozen=True)
class Difference:
    """One method less another in one scope."""

    #: Label of the first method.
    first: str
    #: Label of the second.
    second: str
    #: Name of the metric.
    metric: str
    #: A scope of `statistics.pairing.scopes`.
    scope: str
    #: First less second, in the metric's unit.
    estimate: Estimate
    #: Probability that the first is better, in the metric's own direction.
    better: float | None
    #: p-value, adjusted over the perturbations for perturbations and over the pairs of methods
    #: for the macro mean; None where nothing is adjusted.
    p_adjusted: float | None = None


@dataclass(frozen=True)
class Standing:
    """Where one method stands among others."""

    #: Its label.
    label: str
    #: Mean in the macro scope, over seeds.
    mean: float
    #: Standard deviation of that mean over seeds; None with one seed.
    seed_deviation: float | None
    #: Number of seeds.
    seeds: int
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

    The runs must have passed `statistics.pairing.refuse_unlike`.

    Args:
        runs: at least two methods.
        metric: a metric that all have.
        resamples: of each interval.
        seed: of the resampling.
        scope: the only scope that is wanted; None takes all.

    Raises:
        UsageError: two methods have no seed in common.
    """
    differences: list[Difference] = []
    for first, second in combinations(runs, 2):
        differences += _holm_perturbations(_pair(first, second, metric, resamples, seed, scope))
    places = [index for index, item in enumerate(differences) if item.scope == MACRO]
    _adjust(differences, places)
    return differences


def _pair(
    first: MethodRuns,
    second: MethodRuns,
    metric: str,
    resamples: int,
    seed: int,
    only: str | None,
) -> list[Difference]:
    seeds = common_seeds(first, second)
    found = []
    for scope, weights in scopes(first.first).items():
        if only not in (None, scope):
            continue
        samples = [
            first.values(capture, metric, seeds) - second.values(capture, metric, seeds)
            for capture in weights
        ]
        estimate = bootstrap_mean(samples, list(weights.values()), resamples=resamples, seed=seed)
        better = estimate.above
        if better is not None and not metric_facts(metric).higher_is_better:
            better = 1 - better
        found.append(Difference(first.label, second.label, metric, scope, estimate, better))
    return found


def _holm_perturbations(found: list[Difference]) -> list[Difference]:
    _adjust(found, [index for index, item in enumerate(found) if item.scope in PERTURBATIONS])
    return found


def _adjust(found: list[Difference], places: list[int]) -> None:
    """Put Holm's p-values of one family into the list."""
    tested = [(place, p) for place in places if (p := found[place].estimate.p) is not None]
    for (place, _), value in zip(tested, holm([p for _, p in tested]), strict=True):
        found[place] = replace(found[place], p_adjusted=value)


def standings(
    runs: Sequence[MethodRuns], metric: str, differences: Sequence[Difference]
) -> list[Standing]:
    """Return the methods, best first, with their tie groups.

    Args:
        runs: the methods.
        metric: the metric of `differences`.
        differences: what `compare` found; pairs with an adjusted p below `ALPHA` in the macro
            scope differ significantly.
    """
    higher = metric_facts(metric).higher_is_better
    means = {run.label: macro_by_seed(run, metric) for run in runs}
    order = sorted(runs, key=lambda run: float(means[run.label].mean()) * (-1 if higher else 1))
    places = {run.label: place for place, run in enumerate(order)}
    different = {}
    for item in differences:
        if item.scope == MACRO and item.metric == metric:
            low, high = sorted((places[item.first], places[item.second]))
            different[low, high] = item.p_adjusted is not None and item.p_adjusted < ALPHA
    return [
        Standing(
            run.label,
            float(means[run.label].mean()),
            float(means[run.label].std(ddof=1)) if len(run.seeds) > 1 else None,
            len(run.seeds),
            ties,
        )
        for run, ties in zip(order, tie_groups(len(order), different), strict=True)
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


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p-values so that the chance of any false finding stays at the level.

    Args:
        p_values: of the comparisons of one family, in any order.

    Returns:
        The adjusted values, in the same order, at most 1.

    Source: Holm, A simple sequentially rejective multiple test procedure, 1979.
    """
    order = sorted(range(len(p_values)), key=lambda index: p_values[index])
    adjusted = [1.0] * len(p_values)
    running = 0.0
    for rank, index in enumerate(order):
        running = max(running, min(1.0, (len(p_values) - rank) * p_values[index]))
        adjusted[index] = running
    return adjusted


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
    return [
        "".join(_letter(place) for place, group in enumerate(groups) if item in group)
        for item in range(count)
    ]


def _letter(place: int) -> str:
    """Return `a` to `z`, then `a1`, `b1`, ..."""
    return chr(ord("a") + place % 26) + (str(place // 26) if place >= 26 else "")
