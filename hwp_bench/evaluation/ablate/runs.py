"""Run every variant of a method on every capture with every seed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hwp_bench.analysis.statistics.pairing import MethodRuns
from hwp_bench.base.folders import exclusive
from hwp_bench.capture.splits import Split
from hwp_bench.evaluation.ablate.design import Design, Variant
from hwp_bench.evaluation.capture_evaluation import evaluation_job
from hwp_bench.evaluation.evaluate import (
    EvaluationSettings,
    Plan,
    hiding,
    make_plan,
    open_captures,
    with_setting_files,
)
from hwp_bench.evaluation.results_folder import (
    RESULTS,
    finish_together,
    open_results_folder,
    say_kept,
)
from hwp_bench.methods.manifest import MethodManifest
from hwp_bench.metrics.lpips import load_available
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
    overwrite: bool = False,
    rehearse: bool = False,
) -> AblationRuns:
    """Run an ablation; what is on disk from an earlier start is taken as it is, and said.

    Results of other settings are refused, or stay until all new ones are whole.

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
        overwrite: results of another ablation in `out` may be replaced.
        rehearse: make each variant of the method once before the first job, where any of its
            jobs is to be run; not to be asked for where they run on other machines.

    Raises:
        UsageError: `out` holds results of another ablation.
        MethodFailed: a variant cannot be made.
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
    with exclusive(out):
        folders = {
            key: open_results_folder(
                out / result_folder(*key), plan.results([]), plan.evaluations, overwrite=overwrite
            )
            for key, plan in plans.items()
        }
        say_kept(list(folders.values()))
        # By capture, so that a result file lists captures in one order whichever ended first.
        finished = {key: dict(folder.kept) for key, folder in folders.items()}
        missing = [
            (seed, number, variant)
            for seed, number, variant in order
            if number not in folders[variant.name, seed].kept
        ]
        if rehearse:
            for name in dict.fromkeys(variant.name for _, _, variant in missing):
                plans[name, seeds[0]].rehearse()
        jobs = []
        for seed, number, variant in missing:
            evaluation = hiding(plans[variant.name, seed].evaluations[number], out)
            folder = folders[variant.name, seed].unfinished(number)
            text = f"{evaluation.capture.info.id}, {variant.name}, seed {seed}"
            jobs.append(evaluation_job(evaluation, folder, text, needs or Needs()))

        def on_done(index: int) -> None:
            seed, number, variant = missing[index]
            key = variant.name, seed
            finished[key][number] = folders[key].finish(number)
            if not folders[key].replaces:
                write_results(folders[key].root / RESULTS, _results(plans[key], finished[key]))

        (engine or LocalEngine()).run(jobs, on_done, on_job)
        whole = [(folders[key], _results(plans[key], finished[key])) for key in plans]
        finish_together(whole, tables=False)
    return AblationRuns(design, _runs(design, plans, finished, seeds))


def _results(plan: Plan, finished: Mapping[int, CaptureResult]) -> Results:
    return plan.results([result for _, result in sorted(finished.items())])


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
                seed: _results(plans[variant.name, seed], finished[variant.name, seed])
                for seed in seeds
            },
        )
        for variant in design.variants
    }
