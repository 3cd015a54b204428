"""The effect of components on scores and seconds, paired by capture, seed and frame; its tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.analysis.bootstrap import RESAMPLES, bootstrap_mean
from hwp_bench.analysis.columns import Filled, score_column, table_of
from hwp_bench.analysis.compare import (
    Contrast,
    contrast_columns,
    contrasts,
    macro_by_seed,
    one_capture_notes,
    scope_title,
)
from hwp_bench.analysis.cost import seconds_table
from hwp_bench.analysis.pairing import MethodRuns, common_metrics, scope_scores, scopes
from hwp_bench.base.files import write_json
from hwp_bench.base.records import flattened
from hwp_bench.base.tables import Column, Table, to_object
from hwp_bench.evaluation.ablate.runs import AblationEffect, AblationRuns, result_folder
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.metrics.score import Scores, mean_scores
from hwp_bench.report.tables import HEADLINE, PAPER
from hwp_bench.results import CaptureResult
from hwp_bench.results.schema import score_rows
from hwp_bench.results.store import ABLATION, ABLATION_SCHEMA
from hwp_bench.taxonomy import PERTURBATIONS

#: The times that are compared, with what each is of.
QUANTITIES = {"step": "optimizer step", "fit": "whole fit", "render": "rendered frame"}
_YES, _NO = "yes", "–"
#: Tables that the command prints; all are written.
PRINTED = ("ablation", "perturbations", "gains", "component_cost")
#: Scopes of the first table; each perturbation is one of the second.
_GROUPS = ("single", "interacting", "macro")


@dataclass(frozen=True, kw_only=True)
class ScoreEffect(Contrast):
    """An effect in one metric and scope.

    Score with the component less score without it. For interactions: the gain of both together less
    the sum of their gains alone.
    """

    effect: str
    #: Its kind, see `AblationEffect`.
    kind: str


@dataclass(frozen=True)
class CostEffect:
    """The cost of a component."""

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
    high: float | None
    #: Captures that it rests on.
    captures: int


def score_effects(
    ablation: AblationRuns, metrics: Sequence[str], *, resamples: int = RESAMPLES
) -> list[ScoreEffect]:
    """Return every effect in every metric and scope."""
    seeds = sorted(ablation.any_run.seeds)
    return [
        ScoreEffect(effect=effect.title, kind=effect.kind, **vars(item))
        for effect in ablation.design.effects
        for metric in metrics
        for item in contrasts(
            [(factor, ablation.runs[name]) for name, factor in effect.contrast.items()],
            metric,
            seeds,
            resamples=resamples,
        )
    ]


def seconds(capture: CaptureResult, quantity: str) -> float | None:
    """Return a time of one capture in seconds; None where the method reports none."""
    spent, units = {
        "step": (capture.fit_seconds, capture.steps),
        "fit": (capture.fit_seconds, 1),
        "render": (capture.render_seconds, len(capture.frames)),
    }[quantity]
    return spent / units if spent and units else None


def cost_effects(ablation: AblationRuns) -> list[CostEffect]:
    """Return the cost of every component, as ratios paired by capture and seed.

    Captures without a recorded time are left out.
    """
    found = []
    effects = ablation.design.effects
    # Where components are crossed, their mean over the others says what they cost.
    crossed = any(effect.kind == "main" for effect in effects)
    for effect in effects:
        if effect.kind != "interaction" and not (crossed and effect.kind == "out"):
            rows = [_cost_effect(ablation, effect, quantity) for quantity in QUANTITIES]
            found += [row for row in rows if row is not None]
    return found


def _cost_effect(
    ablation: AblationRuns, effect: AblationEffect, quantity: str
) -> CostEffect | None:
    # Mean log seconds by capture, (S,) each. The positive coefficients add up to 1, the negative
    # ones to -1: weights of two means.
    with_it: list[np.ndarray] = []
    without: list[np.ndarray] = []
    for capture in scopes(ablation.any_run.first)["macro"]:
        logs = [_logs(ablation.runs[name], capture, quantity) for name in effect.contrast]
        known = [
            (factor, log)
            for factor, log in zip(effect.contrast.values(), logs, strict=True)
            if log is not None
        ]
        if len(known) == len(logs):
            with_it.append(np.sum([factor * log for factor, log in known if factor > 0], axis=0))
            without.append(np.sum([-factor * log for factor, log in known if factor < 0], axis=0))
    if not with_it:
        return None
    ratios = [(more - less)[:, None] for more, less in zip(with_it, without, strict=True)]
    estimate = bootstrap_mean(ratios)
    # A ratio beyond e^50 only means that the interval has no upper end.
    low, high = (
        None if log is None or abs(log) > 50 else 100 * math.expm1(log)
        for log in (estimate.low, estimate.high)
    )
    seconds_with, seconds_without = (
        float(np.exp(np.mean([row.mean() for row in rows]))) for rows in (with_it, without)
    )
    percent = 100 * math.expm1(estimate.value)
    return CostEffect(
        effect.title, quantity, seconds_with, seconds_without, percent, low, high, len(ratios)
    )


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


# --- tables, and the record `ablation.json`


def ablation_tables(
    ablation: AblationRuns, effects: Sequence[ScoreEffect], costs: Sequence[CostEffect]
) -> dict[str, Table]:
    """Return every table of an ablation, by name.

    `ablation` (a row per variant: the paper's columns, and the time), `perturbations` (scores by
    perturbation), `paper` (as `ablation`, in the protocol paper-wildghand), `gains` (a row per
    effect, in PSNR), `effects`, `effects_perturbations`, `component_cost`, `seeds`, `seconds`
    (where those of all runs went).
    """
    runs = list(ablation.runs.values())
    headline = common_metrics(runs, HEADLINE)
    tables = {
        "ablation": variant_table(ablation, headline),
        "gains": gain_table([item for item in effects if item.metric == HEADLINE[0]]),
        "effects": effect_table([item for item in effects if item.scope not in PERTURBATIONS]),
        "effects_perturbations": effect_table([e for e in effects if e.scope in PERTURBATIONS]),
        "component_cost": cost_table(costs),
        "seeds": seed_table(ablation, headline),
    }
    by_perturbation = perturbation_table(ablation, headline)
    if any(column.group for column in by_perturbation.columns):
        tables["perturbations"] = by_perturbation
    if paper := common_metrics(runs, PAPER):
        tables["paper"] = variant_table(ablation, paper)
    if (spent := seconds_table(runs)) is not None:
        tables["seconds"] = spent
    return tables


def variant_table(ablation: AblationRuns, metrics: Sequence[str]) -> Table:
    """Return one row per variant: its components, mean scores over seeds, and its cost."""
    runs = list(ablation.runs.values())
    columns = [
        *_component_columns(ablation),
        *_score_columns(ablation, metrics, _GROUPS),
        (Column("Step [ms]", 1, group="Time"), [_mean_time(run, "step", 1e3) for run in runs]),
        (Column("Fit [s]", 1, group="Time"), [_mean_time(run, "fit") for run in runs]),
        (
            Column("Failed frames", 0),
            [sum(capture.failed_frames for capture in _captures(run)) for run in runs],
        ),
    ]
    first = ablation.any_run.first
    suite = "" if first.suite == "captures" else f"{first.suite}: "
    note = (
        f"{suite}{len(first.captures)} captures, seeds "
        f"{', '.join(map(str, sorted(ablation.any_run.seeds)))}; protocol "
        f"{metric_facts(metrics[0]).protocol}; means over captures of means over test frames, then "
        "over seeds. Step and fit: means over captures and seeds, on the method's own clock."
    )
    return table_of("Ablation", columns, [base_text(ablation), note])


def base_text(ablation: AblationRuns) -> str:
    """Say in one line what the first row is: what is out of it, and what all rows keep."""
    design = ablation.design
    settings = dict(flattened(ablation.any_run.first.method.settings))
    # What a setting of the preset or the command line turns off stays in nowhere.
    kept = [
        item.name
        for item in design.kept
        if any(settings.get(name) != value for name, value in flattened(item.settings))
    ]
    first = design.variants[0]
    parts = [f"Base row: {design.base.name if design.base else 'the method'} {first.title}".strip()]
    parts.append(f"keeps {', '.join(kept) or 'no other component'}, as all rows do")
    if ablation.settings:
        given = ", ".join(f"{name}={value}" for name, value in flattened(ablation.settings))
        parts.append(f"set in all rows: {given}")
    return "; ".join(parts) + "."


def perturbation_table(ablation: AblationRuns, metrics: Sequence[str]) -> Table:
    """Return one row per variant: its scores by perturbation, means over seeds."""
    columns = [
        *_component_columns(ablation),
        *_score_columns(ablation, metrics[:3], PERTURBATIONS),
    ]
    note = "Mean over the captures with the perturbation; a capture may have several."
    return table_of("Ablation by perturbation", columns, [note])


def _component_columns(ablation: AblationRuns) -> list[Filled]:
    design = ablation.design
    return [
        (
            Column(item.title),
            [_YES if (item.name in v.thrown) == item.alternative else _NO for v in design.variants],
        )
        for item in (*design.components, *design.alternatives)
    ]


def _score_columns(
    ablation: AblationRuns, metrics: Sequence[str], groups: Sequence[str]
) -> list[Filled]:
    """Return a group of columns for each scope that the captures have."""
    means = [_means(run) for run in ablation.runs.values()]
    return [
        (score_column(name, scope_title(group)), [mean.get(group, {}).get(name) for mean in means])
        for group in groups
        if any(group in mean for mean in means)
        for name in metrics
    ]


def _means(run: MethodRuns) -> dict[str, Scores]:
    """Return mean scores over seeds by scope."""
    every = [scope_scores(score_rows(result)) for result in run.seeds.values()]
    return {scope: mean_scores(one[scope] for one in every) for scope in every[0]}


def _captures(run: MethodRuns) -> list[CaptureResult]:
    return [capture for result in run.seeds.values() for capture in result.captures]


def _mean_time(run: MethodRuns, quantity: str, factor: float = 1.0) -> float | None:
    spent = [value for c in _captures(run) if (value := seconds(c, quantity)) is not None]
    return factor * sum(spent) / len(spent) if spent else None


#: What the kinds of effects are, for a line under a table.
_KINDS = {
    "main": "score with the component less score without it, mean over the other components "
    "in and out",
    "interaction": "what two bring together beyond the sum of what each brings alone",
    "out": "the full method less the one without",
    "alternative": "the method less the one with the alternative",
}
_INTERVAL = (
    "95 % intervals: paired bootstrap over captures, then seeds and blocks of frames, read with "
    "Student's t (docs/statistics.md)."
)


def _kinds_note(effects: Sequence[ScoreEffect]) -> str:
    kinds = dict.fromkeys(item.kind for item in effects)
    return "; ".join(f"{kind}: {_KINDS[kind]}" for kind in kinds) + "."


def gain_table(effects: Sequence[ScoreEffect]) -> Table:
    """Return one row per effect, and a group of columns for each scope: gain and interval.

    All effects are in one metric.
    """
    facts = metric_facts(effects[0].metric)
    found = {(item.effect, item.kind, item.scope): item for item in effects}
    rows = list(dict.fromkeys((effect, kind) for effect, kind, _ in found))
    columns: list[Filled] = [(Column("Effect"), [effect for effect, _ in rows])]
    if {"main", "out"} <= {kind for _, kind in rows}:
        columns.append((Column("Kind"), [kind for _, kind in rows]))
    for scope in dict.fromkeys(item.scope for item in effects):
        own = [found[effect, kind, scope] for effect, kind in rows]
        title = f"{scope_title(scope)} ({own[0].estimate.captures})"
        columns += [
            (Column(name, facts.digits, group=title), [getattr(i.estimate, field) for i in own])
            for name, field in (("Gain", "value"), ("Low", "low"), ("High", "high"))
        ]
    unit = f", {facts.unit}" if facts.unit else ""
    notes = [
        f"{facts.label}{unit}; in brackets the captures. {_kinds_note(effects)}",
        _INTERVAL,
        *one_capture_notes(effects),
    ]
    return table_of("Gains", columns, notes)


def effect_table(effects: Sequence[ScoreEffect]) -> Table:
    """Return one row per effect, metric and scope."""
    columns: list[Filled] = [
        (Column("Effect"), [item.effect for item in effects]),
        (Column("Kind"), [item.kind for item in effects]),
        (Column("Metric"), [metric_facts(item.metric).label for item in effects]),
        # Metrics have their own digits; the finest serve all.
        *contrast_columns(effects, "ssim", "P(better)"),
    ]
    notes = (
        _kinds_note(effects),
        f"{_INTERVAL} p (Holm): over the perturbations. Detectable: the true effect that such an "
        "ablation finds with 80 % probability.",
        *one_capture_notes(effects),
    )
    return table_of("Effects", columns, notes)


def cost_table(costs: Sequence[CostEffect]) -> Table:
    """Return one row per component and quantity."""
    columns: list[Filled] = [
        (Column("Component"), [item.effect for item in costs]),
        (Column("Of a"), [QUANTITIES[item.quantity] for item in costs]),
        (Column("With [ms]", 1), [1000 * item.with_it for item in costs]),
        (Column("Without [ms]", 1), [1000 * item.without for item in costs]),
        (Column("More time [%]", 1), [item.percent for item in costs]),
        (Column("Low", 1, group="95 % interval"), [item.low for item in costs]),
        (Column("High", 1, group="95 % interval"), [item.high for item in costs]),
        (Column("Captures", 0), [item.captures for item in costs]),
    ]
    note = (
        "Ratios paired by capture and seed; geometric means. Under a budget of seconds the fits "
        "take the same time and the cost shows in the steps."
    )
    return table_of("Cost of the components", columns, [note])


def seed_table(ablation: AblationRuns, metrics: Sequence[str]) -> Table:
    """Return one row per variant: the spread of the macro means over seeds."""
    columns: list[Filled] = [(Column("Variant"), list(ablation.runs))]
    for metric in metrics:
        facts = metric_facts(metric)
        values = [macro_by_seed(run, metric) for run in ablation.runs.values()]
        spread = [float(v.std(ddof=1)) if len(v) > 1 else None for v in values]
        columns.append((Column(facts.label, facts.digits + 1), spread))
    return table_of(
        "Spread over seeds", columns, ["Standard deviation of the macro mean over seeds."]
    )


def ablation_record(
    ablation: AblationRuns,
    effects: Sequence[ScoreEffect],
    costs: Sequence[CostEffect],
    tables: Mapping[str, Table],
) -> dict[str, Any]:
    """Return the JSON object of an ablation; paths are relative to its folder."""
    design = ablation.design
    first = ablation.results[0]
    names = ("name", "title", "description", "settings", "alternative")
    return {
        "schema": ABLATION_SCHEMA,
        "method": {"name": first.method.name, "digest": first.method.digest},
        "preset": first.method.preset,
        "base": design.base.name if design.base else None,
        "kept": [item.name for item in design.kept],
        "suite": first.suite,
        "budget": first.budget,
        "frames": first.frames,
        "toolkit": first.toolkit,
        "environment": first.environment,
        "seeds": sorted(ablation.any_run.seeds),
        "captures": [
            {"id": c.id, "digest": c.digest, "split_digest": c.split_digest} for c in first.captures
        ],
        "switches": [
            {name: getattr(item, name) for name in names}
            for item in (*design.components, *design.alternatives)
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
        "process_seconds": sum(
            capture.wall_seconds for result in ablation.results for capture in result.captures
        ),
        "score_effects": [asdict(item) for item in effects],
        "cost_effects": [asdict(item) for item in costs],
        "tables": {name: to_object(table) for name, table in tables.items()},
    }


def write_record(out: Path, record: Mapping[str, Any]) -> Path:
    """Write `ablation.json`."""
    return write_json(out / ABLATION, dict(record))
