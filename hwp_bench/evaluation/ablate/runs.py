"""Run every variant of a method on every capture with every seed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hwp_bench.analysis.statistics.pairing import MethodRuns
from hwp_bench.base.locks import exclusive
from hwp_bench.capture.splits import Split
from hwp_bench.evaluation.ablate.design import Design, Variant
from hwp_bench.evaluation.capture_evaluation import evaluation_job, read_result
from hwp_bench.evaluation.evaluate import (
    EvaluationSettings,
    Plan,
    make_plan,
    open_captures,
    with_setting_files,
)
from hwp_bench.methods.manifest import MethodManifest
from hwp_bench.metrics.lpips_weights import load_available
from hwp_bench.results import CaptureResult, Results, write_results
from hwp_bench.run.engine import Engine, LocalEngine, Needs

#: Called when a job begins, with (index, count, text); returns what is to be called with
#: (done, total) steps meanwhile.
OnJob = Callable[[int, int, str], Callable[[int, int], None] | None]


@dataclass(frozen=True)
class AblationRuns:
    """Every evaluation of an ablation."""

    #: The variants that were run.
    design: Design
    #: The evaluations by variant, in the design's order.
    runs: Mapping[str, MethodRuns]

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
    on_job: OnJob | None = None,
    engine: Engine | None = None,
    needs: Needs | None = None,
) -> AblationRuns:
    """Run an ablation; what is on disk from an earlier start is taken as it is.

    The jobs go seed by seed and capture by capture, all variants of a capture after each other:
    the variants are then timed under the same load, and whenever the run is stopped, all have
    been given the same captures. Which variant goes first changes from capture to capture.

    Args:
        manifest: the method.
        design: the variants.
        captures: capture folders.
        out: folder of the ablation.
        settings: of every evaluation; its seed is not used.
        seeds: the seeds.
        splits: splits by capture id; None applies the 80/10/10 rule.
        on_job: hook for showing progress, where jobs run in turn.
        engine: where jobs run; one after another in this process if None.
        needs: what one job takes of a machine.

    Raises:
        BadMethod: there is no such preset.
        BadCapture, BadInput, BadImage, BadSplit: a capture is wrong.
        HwpError: another run is writing to `out`, or nobody can.
    """
    settings = with_setting_files(manifest, settings)
    opened = open_captures(captures, splits)
    networks = load_available()
    plans = {
        (variant.name, seed): make_plan(
            replace(manifest, title=_title(manifest, variant)),
            opened,
            _of_variant(settings, variant, seed),
            networks,
        )
        for variant in design.variants
        for seed in seeds
    }
    order = [
        (seed, number, variant)
        for seed in seeds
        for number in range(len(opened))
        for variant in _rotated(design.variants, number + seed)
    ]
    # By capture, so that a result file lists captures in one order whichever ended first.
    finished: dict[tuple[str, int], dict[int, CaptureResult]] = {key: {} for key in plans}
    jobs = []
    for seed, number, variant in order:
        evaluation = plans[variant.name, seed].evaluations[number]
        name = evaluation.capture.info.id
        folder = out / result_folder(variant.name, seed) / "captures" / name
        text = f"{name}, {variant.name}, seed {seed}"
        jobs.append(evaluation_job(evaluation, folder, text, needs or Needs()))

    def on_done(index: int) -> None:
        seed, number, variant = order[index]
        done = finished[variant.name, seed]
        done[number] = read_result(jobs[index].output)
        results = plans[variant.name, seed].results([done[key] for key in sorted(done)])
        write_results(out / result_folder(variant.name, seed) / "results.json", results)

    with exclusive(out):
        (engine or LocalEngine()).run(jobs, on_done, on_job)
    return AblationRuns(design, _runs(design, plans, finished, seeds))


def _of_variant(settings: EvaluationSettings, variant: Variant, seed: int) -> EvaluationSettings:
    overrides = {**settings.run.settings, **variant.settings}
    return replace(settings, run=replace(settings.run, settings=overrides, seed=seed))


def _rotated(variants: Sequence[Variant], by: int) -> list[Variant]:
    start = by % len(variants)
    return [*variants[start:], *variants[:start]]


def _title(manifest: MethodManifest, variant: Variant) -> str:
    return f"{manifest.title} {variant.title}".strip()


def _runs(
    design: Design,
    plans: Mapping[tuple[str, int], Plan],
    finished: Mapping[tuple[str, int], Mapping[int, CaptureResult]],
    seeds: Sequence[int],
) -> dict[str, MethodRuns]:
    return {
        variant.name: MethodRuns(
            plans[variant.name, seeds[0]].manifest.title,
            {
                seed: plans[variant.name, seed].results(
                    [result for _, result in sorted(finished[variant.name, seed].items())]
                )
                for seed in seeds
            },
        )
        for variant in design.variants
    }
