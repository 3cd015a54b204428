"""The design of an ablation (its variants, and the effects that they make known), and its runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from pathlib import Path
from typing import Any, Unpack

from hwp_bench.analysis.pairing import MethodRuns
from hwp_bench.base.errors import UsageError, did_you_mean
from hwp_bench.base.records import flattened
from hwp_bench.capture.splits import Split
from hwp_bench.commitments.publication import open_captures
from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
from hwp_bench.evaluation.evaluate import How, OnCapture, make_plan, run_plans, with_setting_files
from hwp_bench.methods.manifest import MANIFEST, Base, MethodManifest, Switch
from hwp_bench.metrics.lpips import load_available
from hwp_bench.results import Results

#: Components that are crossed when nothing is asked for and the method names none.
DEFAULT_FACTORS = 2
#: Most components that are crossed: 2^4 variants.
MAX_FACTORS = 4
#: Name of the variant with no switch thrown.
FULL = "full"


@dataclass(frozen=True)
class Variant:
    """The method with some switches thrown."""

    #: `full`, `no-dpd`, `no-dpd+no-pao`, `binary-mask`.
    name: str
    #: Its name in tables, without the method's name; empty for the full method.
    title: str
    #: Names of the switches that are thrown.
    thrown: tuple[str, ...]
    #: Settings that override the preset, by dotted name.
    settings: Mapping[str, Any]


@dataclass(frozen=True)
class AblationEffect:
    """A difference between variants that answers one question."""

    #: In tables: `DPD`, `DPD x PAO`.
    title: str
    #: `main` (mean over the other components in and out), `interaction`, `out` (of the full
    #: method), or `alternative` (the full method less the one with the alternative).
    kind: str
    #: Coefficient of each variant by name. All add up to 0; the positive ones to 1, or in an
    #: interaction to 2.
    contrast: Mapping[str, float]


@dataclass(frozen=True)
class Design:
    """The variants that an ablation runs and the effects that it measures."""

    #: Components that are taken out.
    components: tuple[Switch, ...]
    #: Alternatives that are put in.
    alternatives: tuple[Switch, ...]
    #: Variants, the barest first, the full method last before the alternatives.
    variants: tuple[Variant, ...]
    effects: tuple[AblationEffect, ...]
    #: Components that all variants have.
    kept: tuple[Switch, ...] = ()
    #: What it starts from in place of the method as it is; None for that.
    base: Base | None = None


def make_design(
    manifest: MethodManifest,
    thrown: Sequence[str] = (),
    crossed: Sequence[str] = (),
    base: str | None = None,
) -> Design:
    """Choose the variants.

    Without names those components are crossed that the method, or the base, names for it, or else
    the first two that the method declares: 2^k variants.
    `crossed` crosses the named components instead: 2^k variants. `thrown` asks what each named
    switch does to the full method: the full method, the method with only one of them thrown,
    and, of two components or more, with all of them out. (With two that is the 2 x 2 again.)
    """
    if thrown and crossed:
        raise UsageError(
            "components are either crossed or taken out one by one", remedy="Leave one out."
        )
    switches = [_switch(manifest, name) for name in dict.fromkeys([*thrown, *crossed])]
    start = None if base is None else _base(manifest, base)
    declared = [item for item in manifest.switches.values() if not item.alternative]
    if start is not None:
        declared = [item for item in declared if item.name in (*start.crossed, *start.kept)]
        for item in switches:
            if not item.alternative and item not in declared:
                raise UsageError(
                    f"{item.name!r} is out of every variant",
                    field="--base",
                    remedy=f"In {base!r} are: {', '.join(one.name for one in declared)}.",
                )
    if not switches:
        named = [manifest.switches[name] for name in (start or manifest).crossed]
        switches = named or declared[:DEFAULT_FACTORS]
        crossed = [item.name for item in switches]
        if not switches:
            raise UsageError(
                "declares no component that could be taken out",
                where=manifest.root / MANIFEST,
                field="switches",
                remedy="docs/methods.md shows how a method declares its switches.",
            )
    components = tuple(item for item in switches if not item.alternative)
    alternatives = tuple(item for item in switches if item.alternative)
    if crossed and (alternatives or len(components) > MAX_FACTORS):
        raise UsageError(f"at most {MAX_FACTORS} components, no alternatives, can be crossed")
    factorial = bool(crossed) or len(components) <= DEFAULT_FACTORS
    outs = [(), *((item,) for item in components), components]
    if factorial:
        counts = range(len(components) + 1)
        outs = [subset for count in counts for subset in combinations(components, count)]
    variants = [_variant(out) for out in sorted(outs, key=len, reverse=True)]
    effects = _factorial_effects(components) if factorial else _out_effects(components)
    if factorial and len(components) > DEFAULT_FACTORS:
        # With two they follow from the main effects and the interaction at a glance.
        effects += _out_effects(components)
    for alternative in alternatives:
        variants.append(_variant((alternative,)))
        contrast = {FULL: 1.0, alternative.variant_name: -1.0}
        effects.append(AblationEffect(f"not {alternative.title}", "alternative", contrast))
    kept = tuple(item for item in declared if item not in components)
    return Design(components, alternatives, tuple(variants), tuple(effects), kept, start)


def _base(manifest: MethodManifest, name: str) -> Base:
    if name in manifest.bases:
        return manifest.bases[name]
    known = ", ".join(manifest.bases) or "none"
    raise UsageError(
        f"{manifest.name} has no base {name!r}",
        where=manifest.root / MANIFEST,
        field="bases",
        remedy=f"It declares: {known}.",
    )


def _switch(manifest: MethodManifest, name: str) -> Switch:
    if name in manifest.switches:
        return manifest.switches[name]
    known = ", ".join(manifest.switches) or "none"
    raise UsageError(
        f"{manifest.name} has no switch {name!r}",
        where=manifest.root / MANIFEST,
        field="switches",
        remedy=did_you_mean(name, manifest.switches) or f"It declares: {known}.",
    )


def _variant(thrown: tuple[Switch, ...]) -> Variant:
    out = [item.title for item in thrown if not item.alternative]
    alternatives = [item.title for item in thrown if item.alternative]
    titles = ([f"without {', '.join(out)}"] if out else []) + [f"with {t}" for t in alternatives]
    settings: dict[str, Any] = {}
    for item in thrown:
        settings |= flattened(item.settings)
    return Variant(name_of(thrown), ", ".join(titles), tuple(i.name for i in thrown), settings)


def name_of(thrown: Sequence[Switch]) -> str:
    """Return the name of the variant with these switches thrown."""
    return "+".join(item.variant_name for item in thrown) or FULL


def _factorial_effects(components: Sequence[Switch]) -> list[AblationEffect]:
    """Main effects and interactions of two; each a mean over the other components in and out."""
    effects = []
    count = len(components)
    for order in (1, 2):
        for chosen in combinations(range(count), order):
            contrast = {}
            for present in product((True, False), repeat=count):
                sign = 1
                for index in chosen:
                    sign *= 1 if present[index] else -1
                out = [c for c, there in zip(components, present, strict=True) if not there]
                contrast[name_of(out)] = sign / 2.0 ** (count - order)
            title = " x ".join(components[index].title for index in chosen)
            effects.append(AblationEffect(title, "main" if order == 1 else "interaction", contrast))
    return effects


def _out_effects(components: Sequence[Switch]) -> list[AblationEffect]:
    effects = [
        AblationEffect(item.title, "out", {FULL: 1.0, name_of((item,)): -1.0})
        for item in components
    ]
    together = {FULL: 1.0, name_of(components): -1.0}
    return [*effects, AblationEffect("all of them", "out", together)]


@dataclass(frozen=True)
class AblationRuns:
    """Every evaluation of an ablation."""

    design: Design
    #: The evaluations by variant, in the design's order.
    runs: Mapping[str, MethodRuns]
    #: Settings that a person gave to all variants.
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def any_run(self) -> MethodRuns:
        """One of the runs; all have the same captures and seeds."""
        return next(iter(self.runs.values()))

    @property
    def results(self) -> list[Results]:
        """Every evaluation."""
        return [result for run in self.runs.values() for result in run.seeds.values()]


def result_folder(variant: str, seed: int) -> str:
    """Return where, in the ablation's folder, one evaluation lies."""
    return f"variants/{variant}/seed-{seed}"


def run_ablation(
    manifest: MethodManifest,
    design: Design,
    captures: Sequence[Path],
    out: Path,
    settings: EvaluationSettings,
    seeds: Sequence[int],
    *,
    splits: Mapping[str, Split] | None = None,
    on_job: OnCapture | None = None,
    **how: Unpack[How],
) -> AblationRuns:
    """Run an ablation; results of an earlier start are kept and listed.

    Results of other settings are refused, or stay until all new ones are whole.

    The jobs go seed by seed and capture by capture, all variants of a capture after each other:
    the variants are then timed under the same load, and whenever the run is stopped, all have
    been given the same captures. Which variant goes first changes from capture to capture.
    """
    given = settings.run.settings
    settings = with_setting_files(manifest, settings)
    opened = open_captures(captures, splits)
    networks = load_available()
    plans, order = {}, []
    # By dotted name, so that a setting of a table leaves the others of it.
    start = dict(flattened(design.base.settings)) if design.base else {}
    asked = dict(flattened(settings.run.settings))
    name = f"{manifest.title} ({design.base.name})" if design.base else manifest.title
    for seed in seeds:
        for variant in design.variants:
            chosen = {**start, **asked, **variant.settings}
            plans[result_folder(variant.name, seed)] = make_plan(
                replace(manifest, title=f"{name} {variant.title}".strip()),
                opened,
                replace(settings, run=replace(settings.run, settings=chosen, seed=seed)),
                networks,
                f"{variant.name}, seed {seed}",
            )
        for number in range(len(opened)):
            first = (number + seed) % len(design.variants)
            turned = (*design.variants[first:], *design.variants[:first])
            order += [(result_folder(variant.name, seed), number) for variant in turned]
    results = run_plans(out, plans, order, on_start=on_job, tables=False, **how)
    runs = {}
    for variant in design.variants:
        by_seed = {seed: results[result_folder(variant.name, seed)] for seed in seeds}
        title = plans[result_folder(variant.name, seeds[0])].manifest.title
        runs[variant.name] = MethodRuns(title, by_seed)
    return AblationRuns(design, runs, given)
