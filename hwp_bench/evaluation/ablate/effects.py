"""The effect of components on scores and seconds, paired by capture, seed and frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hwp_bench.analysis.bootstrap import RESAMPLES, Estimate, bootstrap_mean
from hwp_bench.analysis.compare import holm
from hwp_bench.analysis.pairing import MethodRuns, scopes
from hwp_bench.evaluation.ablate.design import AblationEffect
from hwp_bench.evaluation.ablate.runs import AblationRuns
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.results import CaptureResult
from hwp_bench.taxonomy import PERTURBATIONS


@dataclass(frozen=True)
class ScoreEffect:
    """An effect in one metric and scope."""

    #: Title of the effect.
    effect: str
    #: Its kind, see `ablate.design.AblationEffect`.
    kind: str
    #: Name of the metric.
    metric: str
    #: A scope of `statistics.pairing.scopes`.
    scope: str
    #: Score with the component less score without it; for interactions, what both together
    #: add to the sum of what each adds without the other.
    estimate: Estimate
    #: Probability that it makes the score better, whichever direction that is.
    better: float | None
    #: p-value, adjusted over the perturbations; None in other scopes.
    p_adjusted: float | None = None


@dataclass(frozen=True)
class CostEffect:
    """The cost of a component."""

    #: Title of the effect.
    effect: str
    #: `step` (seconds per optimizer step), `fit` (seconds of the whole fit) or `render`
    #: (seconds per rendered frame).
    quantity: str
    #: Seconds with it, geometric mean over captures, seeds, and the other components.
    with_it: float
    #: Seconds without it.
    without: float
    #: More time with it than without, percent.
    percent: float
    #: Lower end of its 95 % interval.
    low: float | None
    #: Upper end.
    high: float | None
    #: Captures that it rests on.
    captures: int


def score_effects(
    ablation: AblationRuns, metrics: Sequence[str], *, resamples: int = RESAMPLES, seed: int = 0
) -> list[ScoreEffect]:
    """Return every effect in every metric and scope.

    Args:
        ablation: the finished runs.
        metrics: names of metrics that all evaluations have.
        resamples: of each interval.
        seed: of the resampling.
    """
    found: list[ScoreEffect] = []
    for effect in ablation.design.effects:
        for metric in metrics:
            rows = [
                _score_effect(ablation, effect, metric, scope, weights, resamples, seed)
                for scope, weights in scopes(_any_run(ablation).first).items()
            ]
            found += _adjusted(rows)
    return found


def _any_run(ablation: AblationRuns) -> MethodRuns:
    return next(iter(ablation.runs.values()))


def _score_effect(
    ablation: AblationRuns,
    effect: AblationEffect,
    metric: str,
    scope: str,
    weights: dict[str, float],
    resamples: int,
    seed: int,
) -> ScoreEffect:
    seeds = sorted(_any_run(ablation).seeds)
    samples = [
        np.sum(
            [
                factor * ablation.runs[variant].values(capture, metric, seeds)
                for variant, factor in effect.contrast.items()
            ],
            axis=0,
        )
        for capture in weights
    ]
    estimate = bootstrap_mean(samples, list(weights.values()), resamples=resamples, seed=seed)
    better = estimate.above
    if better is not None and not metric_facts(metric).higher_is_better:
        better = 1 - better
    return ScoreEffect(effect.title, effect.kind, metric, scope, estimate, better)


def _adjusted(rows: list[ScoreEffect]) -> list[ScoreEffect]:
    family = [
        (place, row.estimate.p)
        for place, row in enumerate(rows)
        if row.scope in PERTURBATIONS and row.estimate.p is not None
    ]
    for (place, _), value in zip(family, holm([p for _, p in family]), strict=True):
        rows[place] = replace(rows[place], p_adjusted=value)
    return rows


#: Names of the times that are compared.
QUANTITIES = ("step", "fit", "render")


def seconds(capture: CaptureResult, quantity: str) -> float | None:
    """Return a time of one capture in seconds; None where the method does not say.

    Args:
        capture: the result on it.
        quantity: one of `QUANTITIES`.
    """
    spent, units = {
        "step": (capture.fit_seconds, capture.steps),
        "fit": (capture.fit_seconds, 1),
        "render": (capture.render_seconds, len(capture.frames)),
    }[quantity]
    return spent / units if spent and units else None


def cost_effects(ablation: AblationRuns, *, seed: int = 0) -> list[CostEffect]:
    """Return the cost of every component, as ratios paired by capture and seed.

    Captures on which a variant says nothing of its time are left out.
    """
    found = []
    effects = ablation.design.effects
    # Where components are crossed, their mean over the others says what they cost.
    crossed = any(effect.kind == "main" for effect in effects)
    for effect in effects:
        if effect.kind != "interaction" and not (crossed and effect.kind == "out"):
            rows = [_cost_effect(ablation, effect, quantity, seed) for quantity in QUANTITIES]
            found += [row for row in rows if row is not None]
    return found


def _cost_effect(
    ablation: AblationRuns, effect: AblationEffect, quantity: str, seed: int
) -> CostEffect | None:
    with_it: list[np.ndarray] = []
    without: list[np.ndarray] = []
    for capture in scopes(_any_run(ablation).first)["macro"]:
        logs = {
            name: known
            for name in effect.contrast
            if (known := _logs(ablation.runs[name], capture, quantity)) is not None
        }
        if len(logs) < len(effect.contrast):
            continue
        # The positive coefficients add up to 1, the negative ones to -1: weights of two means.
        with_it.append(_weighted(logs, effect, 1))
        without.append(_weighted(logs, effect, -1))
    if not with_it:
        return None
    ratios = [(more - less)[:, None] for more, less in zip(with_it, without, strict=True)]
    estimate = bootstrap_mean(ratios, seed=seed)

    def percent(log: float | None) -> float | None:
        # A ratio beyond e^50 only means that the interval has no upper end.
        return None if log is None or abs(log) > 50 else 100 * math.expm1(log)

    return CostEffect(
        effect.title,
        quantity,
        float(np.exp(np.mean([row.mean() for row in with_it]))),
        float(np.exp(np.mean([row.mean() for row in without]))),
        100 * math.expm1(estimate.value),
        percent(estimate.low),
        percent(estimate.high),
        len(ratios),
    )


def _weighted(logs: dict[str, np.ndarray], effect: AblationEffect, sign: int) -> np.ndarray:
    """(S,) mean log seconds of the variants whose coefficient has this sign."""
    parts = [abs(f) * logs[name] for name, f in effect.contrast.items() if f * sign > 0]
    return np.sum(np.stack(parts), axis=0)


def _logs(run: MethodRuns, capture: str, quantity: str) -> np.ndarray | None:
    """(S,) log seconds on one capture, by seed."""
    spent = [
        seconds(result, quantity)
        for _, results in sorted(run.seeds.items())
        for result in results.captures
        if result.id == capture
    ]
    known = [value for value in spent if value is not None]
    return np.log(known) if len(known) == len(spent) else None
