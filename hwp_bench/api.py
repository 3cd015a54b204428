"""Evaluate, score and compare from Python: the functions that `import hwp_bench` offers.

Each does what the command of its name does.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from hwp_bench.analysis.compare import Comparison, compare_results
from hwp_bench.base.console import JobsView, notice
from hwp_bench.base.errors import UsageError, of_type, place, whole_number
from hwp_bench.base.folders import scratch_folder
from hwp_bench.base.records import whole_seed
from hwp_bench.capture import Capture
from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
from hwp_bench.evaluation.evaluate import (
    check_call,
    check_results_place,
    check_suite,
    default_folder,
    make_budget,
)
from hwp_bench.evaluation.evaluate import evaluate as evaluate_method
from hwp_bench.evaluation.sentences import outcome_lines
from hwp_bench.methods.contract import MethodFactory, RunSettings
from hwp_bench.methods.manifest import find_method, read_manifest
from hwp_bench.methods.source import write_method
from hwp_bench.metrics.lpips import load_available
from hwp_bench.metrics.score import Network, score_frame
from hwp_bench.report.tables import HEADLINE
from hwp_bench.results import Results, read_all
from hwp_bench.run.engine import Engine, LocalEngine
from hwp_bench.run.engine.processes import ParallelEngine
from hwp_bench.suites.suite import ensure_suite
from hwp_bench.taxonomy import SUITES

#: The name of a suite; or a capture or its folder, of which `evaluate` takes one or several.
Captures: TypeAlias = (
    "str | os.PathLike[str] | Capture | Sequence[os.PathLike[str] | str | Capture]"
)


def evaluate(
    method: str | os.PathLike[str] | MethodFactory,
    captures: Captures = "mini",
    out: str | os.PathLike[str] | None = None,
    *,
    preset: str | None = None,
    settings: Mapping[str, Any] | None = None,
    seed: int = 0,
    seconds: float | None = None,
    steps: int | None = None,
    frames: str = "perturbed",
    jobs: int = 1,
    overwrite: bool = False,
) -> Results:
    """Run a method on captures and score it, as `hwp-bench evaluate` does.

    An evaluation that is started again with the same arguments takes finished captures as they
    are. Before the first capture the method is made once with its settings.

    Args:
        method: method directory; the name of one that ships (`plain`, `wildghand`) or that is
            installed; or a class or function that is called with `settings` and `seed` and returns
            a `hwp_bench.methods.Method`. Its source, with what it uses of its own file or
            notebook, becomes a method directory for this call: it runs in a process of its own and
            sees none of the variables that are set elsewhere.
        captures: a suite (`smoke`, `mini`, `full`, `wild-dev`, `persistent`, `real-1`; rendered
            or imported on first use), a capture or its folder, or a list of captures and folders.
        out: results folder; `runs/METHOD-SUITE` if None, with the oracle's name, the budget and
            a seed other than 0 behind it.
        preset: preset of the method; the suite's, else `default`, if None.
        settings: settings that override the preset, such as `{"dpd.enabled": False}`.
        seed: seed of all random numbers.
        seconds: limit of the fit on the method's clock, s; without `steps` it lifts the preset's
            limit of steps.
        steps: limit of the fit in optimizer steps.
        frames: training frames that the method is given: `perturbed`, or an oracle's (`clean`,
            `unperturbed-only`).
        jobs: captures that are evaluated at once, each in a process of its own.
        overwrite: replace results of another evaluation in `out`, once the new ones are whole.

    Returns:
        The results, which `out/results.json` then holds; tables are written to `out/tables`.
        Progress is shown on standard error.

    Raises:
        BadMethod: the method directory or the name of a setting is wrong.
        MethodFailed: the method cannot be made: an import fails, or a setting's value is wrong.
        BadCapture, BadInput, BadImage, BadSplit: a capture is wrong.
        UsageError: an argument is of another type or out of range, there is no such suite, or `out`
            lies in the method or in a capture, or holds results of another evaluation.
        HwpError: another evaluation is writing to `out`, or `out` cannot be written.
    """
    with ExitStack() as stack:
        if callable(method):
            method = write_method(method, stack.enter_context(scratch_folder("hwp-method-")))
        method = os.fspath(place(method, "method"))
        suite = captures if isinstance(captures, str) and captures in SUITES else "captures"
        given = _folders(captures) if suite == "captures" else []
        of_type(preset, (str, type(None)), "preset", "a text")
        of_type(settings, (Mapping, type(None)), "settings", "a table of settings by name")
        if whole_number(jobs, "jobs") < 1:
            raise UsageError(f"is {jobs}", field="jobs", remedy="Use 1 or more.")
        plan = EvaluationSettings(
            suite=suite,
            preset=preset,
            run=RunSettings(dict(settings or {}), seed, make_budget(seconds, steps), frames),
        )
        folder = place(out, "out") if out is not None else default_folder(method, plan)
        manifest = read_manifest(find_method(method))
        check_results_place(manifest, folder, {"captures": given}, "out")
        check_call(manifest, plan, folder, overwrite=overwrite)
        rehearsed = suite != "captures" and check_suite(manifest, plan, folder)
        view = JobsView()
        engine: Engine = LocalEngine() if jobs == 1 else ParallelEngine(jobs, view)
        stack.enter_context(engine)
        if engine.in_turn:
            stack.enter_context(view)
        paths = ensure_suite(suite, engine=engine) if suite != "captures" else given
        results = evaluate_method(
            method,
            paths,
            folder,
            plan,
            on_capture=view.turn if engine.in_turn else None,
            engine=engine,
            overwrite=overwrite,
            rehearse=not rehearsed,
        )
    for line in outcome_lines(folder, results):
        notice(line)
    return results


def _folders(captures: Captures) -> list[Path]:
    """The folders of one capture or several."""
    one = isinstance(captures, str | os.PathLike | Capture)
    several = [captures] if one else of_type(captures, Iterable, "captures", "a capture or several")
    folders = [
        item.root if isinstance(item, Capture) else place(item, f"captures[{index}]")
        for index, item in enumerate(several)
    ]
    if not folders:
        raise UsageError("is empty", field="captures", remedy="Name at least one capture.")
    return folders


def score(
    prediction: np.ndarray, target: np.ndarray, mask: np.ndarray, *, exact: bool = False
) -> dict[str, float]:
    """Score one rendered frame in every protocol, on the pixels of the data set's mask.

    Args:
        prediction: (H, W, 3) sRGB, uint8 or float in [0, 1].
        target: (H, W, 3) sRGB, uint8 or float in [0, 1].
        mask: (H, W) uint8 or bool, the visible hand.
        exact: the mask is exact coverage, not an estimate (`Capture.scoring_mask` says so).

    Returns:
        Score by metric; `hwp_bench.metrics.METRICS` says what each means. LPIPS and FLIP are there
        where `evaluate` computes them: where their weights or package are.

    Raises:
        ShapeMismatch: the three do not describe one image.
        BadInput: a pixel is NaN or out of range.
        EmptyMask: the mask leaves nothing to score.
        UsageError: one of them is not an array.
    """
    given = {"prediction": prediction, "target": target, "mask": mask}
    for name, image in given.items():
        of_type(image, np.ndarray, name, "a NumPy array")
    return score_frame(prediction, target, mask, coverage=exact, networks=_networks())


@functools.cache
def _networks() -> Mapping[str, Network]:
    """LPIPS and FLIP, read once: a loop over frames must not wait for weights at each."""
    return load_available()


def compare(
    *results: Results | str | os.PathLike[str],
    metrics: Sequence[str] = HEADLINE,
    resamples: int = 10_000,
    seed: int = 0,
) -> Comparison:
    """Say how sure the differences between methods are, as `hwp-bench compare` does.

    Args:
        results: results, results folders or `results.json` files, of at least two methods on the
            same captures.
        metrics: metrics to compare; those that not all results have are left out.
        resamples: bootstrap resamples of each interval.
        seed: seed of the resampling.

    Raises:
        UsageError: there is only one method, the results are of different data, or an argument
            is of another type or out of range.
        BadInput, BadResult: a results file is missing or wrong.
    """
    names = (
        [metrics] if isinstance(metrics, str) else of_type(metrics, Sequence, "metrics", "names")
    )
    for name in names:
        of_type(name, str, "metrics", "names")
    resamples, seed = whole_number(resamples, "resamples"), whole_seed(seed, "seed")
    read: list[Results] = []
    for result in results:
        read += [result] if isinstance(result, Results) else read_all([place(result, "results")])
    return compare_results(read, names, resamples=resamples, seed=seed)
