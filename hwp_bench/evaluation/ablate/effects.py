"""The effect of components on scores and seconds, paired by capture, seed and frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.analysis.bootstrap import RESAMPLES, Estimate, bootstrap_mean
from hwp_bench.analysis.compare import (
    ONE_CAPTURE,
    estimate_cells,
    estimate_columns,
    holm,
    macro_by_seed,
    scope_title,
)
from hwp_bench.analysis.cost import seconds_table
from hwp_bench.analysis.pairing import MethodRuns, common_metrics, scopes
from hwp_bench.base.files import write_json
from hwp_bench.base.tables import Cell, Column, Table, to_object
from hwp_bench.evaluation.ablate.runs import AblationEffect, AblationRuns, result_folder
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.metrics.score import Scores, aggregate
from hwp_bench.report.tables import HEADLINE, PAPER
from hwp_bench.results import CaptureResult, Results
from hwp_bench.results.schema import score_rows
from hwp_bench.results.store import ABLATION, ABLATION_SCHEMA
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
    """Return every effect in every metric and scope."""
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
    """Return a time of one capture in seconds; None where the method does not say."""
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


#: Scopes of the effects table; perturbations have one of their own.
OVERALL = ("macro", "single", "interacting")

_YES, _NO = "yes", "–"
_GROUPS = {"single": "Single", "interacting": "Interacting", "macro": "Macro"}


def ablation_tables(
    ablation: AblationRuns, effects: Sequence[ScoreEffect], costs: Sequence[CostEffect]
) -> dict[str, Table]:
    """Return every table of an ablation, by name.

    `ablation` (a row a variant: the paper's columns, and the time), `paper` (the same in the
    protocol paper-wildghand), `effects`, `effects_perturbations`, `component_cost`, `seeds`,
    `seconds` (where those of all runs went).
    """
    runs = list(ablation.runs.values())
    headline = common_metrics(runs, HEADLINE)
    perturbed = [item for item in effects if item.scope in PERTURBATIONS]
    tables = {
        "ablation": variant_table(ablation, headline),
        "effects": effect_table([item for item in effects if item.scope in OVERALL]),
        "effects_perturbations": effect_table(perturbed),
        "component_cost": cost_table(costs),
        "seeds": seed_table(ablation, headline),
    }
    paper = common_metrics(runs, PAPER)
    if paper:
        tables["paper"] = variant_table(ablation, paper)
    spent = seconds_table(runs)
    if spent is not None:
        tables["seconds"] = spent
    return tables


def variant_table(ablation: AblationRuns, metrics: Sequence[str]) -> Table:
    """Return one row a variant: what is in it, mean scores over seeds, and what it took."""
    design = ablation.design
    means = {name: _means(run) for name, run in ablation.runs.items()}
    groups = [key for key in _GROUPS if any(key in mean for mean in means.values())]
    columns = [Column(item.title) for item in (*design.components, *design.alternatives)]
    for group in groups:
        for name in metrics:
            facts = metric_facts(name)
            title = f"{facts.label} [{facts.unit}]" if facts.unit else facts.label
            columns.append(Column(title, facts.digits, facts.higher_is_better, _GROUPS[group]))
    columns += [
        Column("Step [ms]", 1, group="Time"),
        Column("Fit [s]", 1, group="Time"),
        Column("Failed frames", 0),
    ]
    rows = []
    for variant in design.variants:
        marks = [_YES if item.name not in variant.thrown else _NO for item in design.components]
        marks += [_YES if item.name in variant.thrown else _NO for item in design.alternatives]
        run = ablation.runs[variant.name]
        scores = [means[variant.name].get(g, {}).get(name) for g in groups for name in metrics]
        rows.append((*marks, *scores, *_times(run)))
    first = next(iter(ablation.runs.values())).first
    protocol = metric_facts(metrics[0]).protocol
    suite = "" if first.suite == "captures" else f"{first.suite}: "
    note = (
        f"{suite}{len(first.captures)} captures, seeds "
        f"{', '.join(map(str, sorted(next(iter(ablation.runs.values())).seeds)))}; protocol "
        f"{protocol}; means over captures of means over test frames, then over seeds. Step and "
        "fit: means over captures and seeds, on the method's own clock."
    )
    return Table("Ablation", tuple(columns), tuple(rows), (note,))


def _means(run: MethodRuns) -> dict[str, Scores]:
    """Return mean scores over seeds by scope."""
    found: dict[str, list[Scores]] = {}
    for result in run.seeds.values():
        mean = aggregate(score_rows(result))
        for scope, summary in (("single", mean.single), ("interacting", mean.interacting)):
            if summary:
                found.setdefault(scope, []).append(summary.capture_mean)
        if mean.overall.macro:
            found.setdefault("macro", []).append(mean.overall.macro)
    return {
        scope: {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}
        for scope, rows in found.items()
    }


def _times(run: MethodRuns) -> list[Cell]:
    captures = [capture for result in run.seeds.values() for capture in result.captures]
    found: list[Cell] = []
    for quantity, factor in (("step", 1000.0), ("fit", 1.0)):
        spent = [value for c in captures if (value := seconds(c, quantity)) is not None]
        found.append(factor * sum(spent) / len(spent) if spent else None)
    return [*found, sum(capture.failed_frames for capture in captures)]


def effect_table(effects: Sequence[ScoreEffect]) -> Table:
    """Return one row an effect, metric and scope."""
    columns = (
        Column("Effect"),
        Column("Kind"),
        Column("Metric"),
        Column("Scope"),
        Column("Captures", 0),
        # Metrics have their own digits; the finest serve all.
        *(Column(c.title, 4, group=c.group) for c in estimate_columns("ssim")),
        Column("P(better)", 3),
        Column("p", 4),
        Column("p (Holm)", 4),
        Column("Detectable", 4),
    )
    rows = tuple(
        (
            item.effect,
            item.kind,
            metric_facts(item.metric).label,
            scope_title(item.scope),
            item.estimate.captures,
            *estimate_cells(item.estimate),
            item.better,
            item.estimate.p,
            item.p_adjusted,
            item.estimate.detectable,
        )
        for item in effects
    )
    notes: tuple[str, ...] = (
        "main: score with the component less score without it, mean over the other components "
        "in and out; interaction: what two bring together beyond the sum of what each brings "
        "alone; out: the full method less the one without; alternative: the method less the one "
        "with the alternative.",
        "95 % intervals: paired bootstrap over captures, then seeds and blocks of frames, read "
        "with Student's t (docs/statistics.md). p (Holm): over the perturbations. Detectable: the "
        "true effect that such an ablation finds with 80 % probability.",
    )
    if any(item.estimate.captures == 1 for item in effects):
        notes = (*notes, ONE_CAPTURE)
    return Table("Effects", columns, rows, notes)


def cost_table(costs: Sequence[CostEffect]) -> Table:
    """Return one row a component and quantity."""
    names = {"step": "optimizer step", "fit": "whole fit", "render": "rendered frame"}
    columns = (
        Column("Component"),
        Column("Of a"),
        Column("With [ms]", 1),
        Column("Without [ms]", 1),
        Column("More time [%]", 1),
        Column("Low", 1, group="95 % interval"),
        Column("High", 1, group="95 % interval"),
        Column("Captures", 0),
    )
    rows = tuple(
        (
            item.effect,
            names[item.quantity],
            1000 * item.with_it,
            1000 * item.without,
            item.percent,
            item.low,
            item.high,
            item.captures,
        )
        for item in costs
    )
    note = (
        "Ratios paired by capture and seed; geometric means. Under a budget of seconds the fits "
        "take the same time and the cost shows in the steps."
    )
    return Table("Cost of the components", columns, rows, (note,))


def seed_table(ablation: AblationRuns, metrics: Sequence[str]) -> Table:
    """Return one row a variant: the spread of the macro means over seeds."""
    facts = [metric_facts(name) for name in metrics]
    columns = (Column("Variant"), *(Column(item.label, item.digits + 1) for item in facts))
    rows = []
    for name, run in ablation.runs.items():
        values = [macro_by_seed(run, metric) for metric in metrics]
        rows.append((name, *(float(v.std(ddof=1)) if len(v) > 1 else None for v in values)))
    note = "Standard deviation of the macro mean over seeds."
    return Table("Spread over seeds", columns, tuple(rows), (note,))


def total_seconds(results: Sequence[Results]) -> float:
    """Return the seconds of all method processes of some evaluations."""
    return sum(capture.wall_seconds for result in results for capture in result.captures)


def ablation_record(
    ablation: AblationRuns,
    effects: Sequence[ScoreEffect],
    costs: Sequence[CostEffect],
    tables: Mapping[str, Table],
) -> dict[str, Any]:
    """Return the JSON object of an ablation; paths are relative to its folder."""
    design = ablation.design
    first = ablation.results[0]
    switches = (*design.components, *design.alternatives)
    return {
        "schema": ABLATION_SCHEMA,
        "method": {"name": first.method.name, "digest": first.method.digest},
        "preset": first.method.preset,
        "suite": first.suite,
        "budget": first.budget,
        "frames": first.frames,
        "toolkit": first.toolkit,
        "environment": first.environment,
        "seeds": sorted(
            result.seed for result in next(iter(ablation.runs.values())).seeds.values()
        ),
        "captures": [
            {"id": c.id, "digest": c.digest, "split_digest": c.split_digest} for c in first.captures
        ],
        "switches": [
            {
                "name": item.name,
                "title": item.title,
                "description": item.description,
                "settings": item.settings,
                "alternative": item.alternative,
            }
            for item in switches
        ],
        "variants": [
            {
                **asdict(variant),
                "results": [
                    f"{result_folder(variant.name, seed)}/results.json"
                    for seed in ablation.runs[variant.name].seeds
                ],
            }
            for variant in design.variants
        ],
        "process_seconds": total_seconds(ablation.results),
        "score_effects": [asdict(item) for item in effects],
        "cost_effects": [asdict(item) for item in costs],
        "tables": {name: to_object(table) for name, table in tables.items()},
    }


def write_record(out: Path, record: Mapping[str, Any]) -> Path:
    """Write `ablation.json`."""
    return write_json(out / ABLATION, dict(record))
