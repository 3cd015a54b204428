"""Check a method in seconds: run it on a toy capture, and list what an evaluation would mark down.

Scores are not looked at. What a method may be is said in `hwp_bench.methods.contract`.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hwp_bench.base.console import notice
from hwp_bench.base.errors import HwpError, MethodFailed, bounded
from hwp_bench.base.folders import scratch_folder
from hwp_bench.capture import Capture
from hwp_bench.capture.check import CheckReport, Finding
from hwp_bench.capture.schema import frame_name
from hwp_bench.capture.splits import Split
from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
from hwp_bench.evaluation.evaluate import make_plan, with_setting_files
from hwp_bench.evaluation.scoring import colour_warnings, read_predictions, read_targets
from hwp_bench.methods.contract import Budget
from hwp_bench.methods.manifest import check_settings, read_manifest
from hwp_bench.methods.request import write_request
from hwp_bench.results.schema import ISOLATED
from hwp_bench.run.runner import RunRecord, last_lines, run_method
from hwp_bench.run.sandbox.confinement import hand_model_files
from hwp_bench.run.worker import FINDINGS, LOG, read_findings
from hwp_bench.sim.produce.capture import SuiteItem, ensure_suite
from hwp_bench.sim.scene_files import load_scene

#: What a checked fit may take where nothing else is asked for.
BUDGET = Budget(seconds=10.0, steps=200)
#: Seconds after which a checked method is killed on one capture.
TIME_LIMIT = 300.0
# The toy capture shows two hands, so that a method which forgets one is found.
_SCENE, _FRAMES, _SIZE = "capture6", 20, 64
# From here on a person is told: a fit beyond its budget, s and share; a picture, s; memory, bytes.
_GRACE_SECONDS, _GRACE = 2.0, 1.5
_SLOW_PICTURE = 1.0
_MUCH_MEMORY = 8e9
# What programs print where they reach no other machine.
_NO_NETWORK = re.compile(
    r"[Nn]etwork is unreachable|[Nn]ame resolution|[Nn]ame or service not known"
    r"|[Cc]ould not resolve host|getaddrinfo failed|No address associated with hostname"
)
_REMEDIES = {
    "shape": "Return (H, W, 3) of the camera that `render` is given.",
    "range": "Return sRGB colour from 0 to 1; what is beyond it is clipped.",
    "nan": "Look for a division by zero, such as the mean of a mask without a pixel.",
    "speed": "Stop when `report.elapsed` is `budget.seconds`, and after `budget.steps`.",
    "memory": "Other machines may have less.",
    "missing": "Write predictions/000123.png for every frame of `split.test` in request.json.",
    "network": "An evaluation has no network: put files into the method's folder, or name them "
    "with --expose.",
}


def toy_capture() -> Path:
    """Return a small simulated capture of two hands, rendered on first use."""
    return ensure_suite([SuiteItem(load_scene(_SCENE), _FRAMES, _SIZE)])[0]


def check_method(
    root: Path, captures: Sequence[tuple[Capture, Split]], settings: EvaluationSettings
) -> CheckReport:
    """Run a method on captures and list what is wrong.

    Faults of the method are not raised: they all go into the report.
    """
    findings: list[Finding] = []
    facts: dict[str, Any] = {}
    try:
        manifest = read_manifest(root)
        check_settings(manifest, settings.run.settings)
        plan = make_plan(manifest, captures, with_setting_files(manifest, settings), {})
    except HwpError as error:
        where = error.where or os.fspath(root)
        found = Finding("error", where, error.field or "manifest", error.problem, error.remedy)
        return CheckReport(os.fspath(root), facts, (found,))
    for evaluation in plan.evaluations:
        capture, split, name = evaluation.capture, evaluation.split, evaluation.capture.info.id
        with scratch_folder("hwp-check-") as scratch:
            request, output = scratch / "request", scratch / "output"
            if manifest.kind != "predictions":
                write_request(request, capture, split, plan.settings.run)
            asked = plan.settings.confinement
            exposed = (*asked.exposed, *hand_model_files(capture.info.hand_model.source))
            confinement = replace(asked, exposed=exposed, hidden=(*asked.hidden, capture.root))
            record = None
            try:
                record = run_method(
                    manifest,
                    name,
                    request,
                    output,
                    time_limit=settings.killed_after,
                    confinement=confinement,
                    check=True,
                )
            except HwpError as error:
                findings.append(_failure(error, name, output))
            heard = list(_heard(output, name))
            findings += heard
            if record is not None:
                facts[name] = _facts(record, capture, split)
                findings += _slow(record, name, len(split.test), settings.run.budget)
                findings += _pictures(record, capture, split, colours=not heard)
    findings.sort(key=lambda finding: finding.level)
    return CheckReport(os.fspath(root), facts, tuple(findings))


def _failure(error: HwpError, name: str, output: Path) -> Finding:
    """Say why a run failed, after the last lines that the method printed."""
    for line in last_lines(output / LOG):
        notice(f"{name}: {line}")
    words = {"ran out of time": "speed", "of memory": "memory", "has no predictions": "missing"}
    check = next((word for text, word in words.items() if text in error.problem), "run")
    remedy = None if isinstance(error, MethodFailed) else error.remedy
    return Finding("error", name, check, error.problem, remedy)


def _heard(output: Path, name: str) -> Iterator[Finding]:
    """Read the findings of the run, and look for failed calls to the network in its log."""
    try:
        found = read_findings(output / FINDINGS)
    except HwpError as error:
        # The method can write there, too.
        yield Finding("error", name, "run", f"left a {FINDINGS} of its own: {error.problem}")
        found = {}
    for check, (problem, *places) in found.items():
        where = f"{name}: {', '.join(places)}"
        yield Finding("error", where, check, problem, _REMEDIES.get(check))
    lines = [line for line in last_lines(output / LOG) if _NO_NETWORK.search(line)]
    if lines and "network" not in found:
        problem = f"the method printed: {lines[-1]}"
        yield Finding("error", name, "network", problem, _REMEDIES["network"])


def _slow(record: RunRecord, name: str, frames: int, budget: Budget) -> Iterator[Finding]:
    """Warn where a run takes more than its budget, or more time or memory than is usual."""
    facts = record.facts
    seconds = facts.fit_seconds or record.wall_seconds
    picture, memory = (facts.render_seconds or 0) / frames, facts.peak_memory or 0
    found = {}
    if budget.seconds is not None and seconds > budget.seconds * _GRACE + _GRACE_SECONDS:
        found[f"the fit took {seconds:.1f} s, and its budget is {budget.seconds:g} s"] = "speed"
    if (facts.steps or 0) > (budget.steps or math.inf):
        found[f"the fit took {facts.steps} steps, and its budget is {budget.steps}"] = "speed"
    if picture > _SLOW_PICTURE:
        found[f"a picture takes {picture:.1f} s, and `mini` has 48, `full` 1,400"] = "speed"
    if memory > _MUCH_MEMORY:
        found[f"the process took {memory / 1e9:.1f} GB of memory"] = "memory"
    for problem, check in found.items():
        yield Finding("warning", name, check, problem, _REMEDIES[check])


def _pictures(
    record: RunRecord, capture: Capture, split: Split, *, colours: bool
) -> Iterator[Finding]:
    """Look at the pictures that were written and, if asked for, at their `colours`."""
    name, clip = capture.info.id, capture.free_view
    parts = [(name, read_targets(capture, split.test.tolist()), record.predictions)]
    if clip is not None and record.free_view is not None:
        views = read_targets(clip, range(len(clip)))
        parts.append((f"{name}, free view", views, record.free_view))
    for place, targets, folder in parts:
        predictions = read_predictions(folder, [one.frame for one in targets], capture.size)
        bad: dict[tuple[str, str], list[int]] = {}
        for one in predictions:
            if one.failure is not None:
                reason = one.failure.partition(": ")[2]
                check = "image" if (folder / frame_name(one.frame)).exists() else "missing"
                check = "shape" if "pixels where" in reason else check
                bad.setdefault((check, reason), []).append(one.frame)
        for (check, reason), frames in bad.items():
            problem = f"{len(frames)} of {len(targets)} pictures: {reason}"
            where = f"{place}: frames {bounded(frames)}"
            yield Finding("error", where, check, problem, _REMEDIES.get(check))
        for text in colour_warnings(targets, predictions) if colours else ():
            yield Finding("error", place, "range", text, _REMEDIES["range"])


def _facts(record: RunRecord, capture: Capture, split: Split) -> dict[str, Any]:
    """Return what a run took; None is what nobody measured."""
    facts, isolation = record.facts, record.isolation
    picture = facts.render_seconds and 1000 * facts.render_seconds / len(split.test)
    memory = facts.peak_memory and facts.peak_memory / 1e9
    return {
        "frames": len(capture),
        "size [px]": capture.info.width,
        "fit [s]": facts.fit_seconds and round(facts.fit_seconds, 3),
        "steps": facts.steps,
        "picture [ms]": picture and round(picture, 1),
        "memory [GB]": memory and round(memory, 3),
        "processes [s]": round(record.wall_seconds, 2),
        "isolated": isolation and ("yes" if isolation == ISOLATED else f"no: {isolation}"),
    }
