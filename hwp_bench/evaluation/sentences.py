"""A result in words: its failures and doubts, and what it lacks of its suite.

Every bad frame is named, up to a number, with a count.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from hwp_bench.evaluation.scoring import read_warnings
from hwp_bench.results import CaptureResult, FrameResult, Results
from hwp_bench.results.schema import isolation_text
from hwp_bench.run.worker import LOG
from hwp_bench.suites.suite import lost_clips

#: Share of its seconds before which a fit ends early.
EARLY = 0.5
#: Share of a core below which a timed fit has shared it with something else.
ALONE = 0.9
#: Most frames of a capture, or fits, that are named; the others are counted.
SHOWN = 12


def outcome_lines(out: Path, results: Results, head: str = "") -> list[str]:
    """Return a line for each failure, log and doubt of an evaluation, and one for its isolation."""
    lines = []
    for capture in results.captures:
        folder = out / "captures" / capture.id
        failed = failures(capture)
        lines += [f"failed: {head}{text}" for text in failed]
        if failed and (folder / LOG).is_file():
            lines.append(f"log: {folder / LOG}")
        lines += [f"warning: {head}{capture.id}: {text}" for text in read_warnings(folder)]
    lines += [f"warning: {head}{results.suite} {text}" for text in lost_clips(results)]
    early, shared = early_text(results), shared_text(results)
    if early:
        lines.append(f"warning: {head}{early}; see {LOG} in their folders")
    if shared:
        lines.append(f"warning: {head}{shared}; run timed fits on an idle machine")
    return lines + [
        text for text in (times_text(results, head), isolation_text(results, head)) if text
    ]


def failures(capture: CaptureResult) -> list[str]:
    """Say which of the frames of a capture and of its free-view clip failed; empty where none."""
    return [text for text in (failure_text(capture), free_view_text(capture)) if text]


def failure_text(capture: CaptureResult) -> str:
    """Say which frames of a capture failed and why; empty where none did.

    A method that failed on the whole capture has one reason; otherwise frames of the same reason
    stand together, at most `SHOWN` of them by name.
    """
    if capture.failure is not None:
        failed, count = capture.failed_frames, len(capture.frames)
        return f"{capture.id}: {failed} of {count} frames: {capture.failure}"
    return _frames_text(capture.id, capture.frames)


def free_view_text(capture: CaptureResult) -> str:
    """Say the same of the frames of the free-view clip."""
    if capture.free_view is None or capture.failure is not None:
        return ""
    return _frames_text(f"{capture.id}, free view", capture.free_view.frames)


def _frames_text(name: str, frames: Sequence[FrameResult]) -> str:
    failed = [frame for frame in frames if frame.failure is not None]
    if not failed:
        return ""
    by_reason: dict[str, list[str]] = {}
    for frame in failed[:SHOWN]:
        file, _, reason = (frame.failure or "").partition(": ")
        by_reason.setdefault(reason, []).append(file)
    parts = [", ".join(files) + f": {reason}" for reason, files in by_reason.items()]
    if len(failed) > SHOWN:
        parts.append(f"and {len(failed) - SHOWN} more")
    return f"{name}: {len(failed)} of {len(frames)} frames: {'; '.join(parts)}"


def early_text(results: Results) -> str:
    """Name the fits that ended within half of their seconds, before their last step; else empty."""
    seconds, most = results.budget.get("seconds"), results.budget.get("steps") or math.inf
    if seconds is None:
        return ""
    early = [
        f"{one.id} ({one.steps} steps, {one.fit_seconds:.1f} s)"
        for one in results.captures
        if one.steps and one.steps < most and one.fit_seconds is not None
        if one.fit_seconds < EARLY * seconds
    ]
    if not early:
        return ""
    count, total = len(early), len(results.captures)
    return f"{count} of {total} fits ended early in {seconds:g} s: {_first_of(early)}"


def shared_text(results: Results) -> str:
    """Name the fits on the CPU, of so many seconds, that had less than a core; else empty."""
    if results.budget.get("seconds") is None:
        return ""
    shared = [
        f"{one.id} ({100 * one.cpu_seconds / one.fit_seconds:.0f} %)"
        for one in results.captures
        if one.device == "cpu" and one.cpu_seconds and one.fit_seconds
        if one.cpu_seconds < ALONE * one.fit_seconds
    ]
    if not shared:
        return ""
    count, total = len(shared), len(results.captures)
    return (
        f"{count} of {total} fits had less than {100 * ALONE:.0f} % of a core: {_first_of(shared)}"
    )


def _first_of(names: Sequence[str]) -> str:
    left = len(names) - SHOWN
    return ", ".join([*names[:SHOWN], *[f"and {left} more"] * (left > 0)])


def times_text(results: Results, head: str = "") -> str:
    """Say how long a method fitted by its own clock, and how long its processes ran by ours.

    The first is what tables show, because it leaves out imports, checkpoints and test frames. It is
    the method's word. The second is not. Empty where no process ran.
    """
    ran = [one for one in results.captures if one.isolation and one.fit_seconds is not None]
    if not ran:
        return ""
    said = sum(one.fit_seconds or 0.0 for one in ran)
    wall = sum(one.wall_seconds for one in ran)
    clocks = f"{said:.1f} s of fitting, by the method's clock; processes ran {wall:.1f} s"
    return f"times: {head}{clocks}"
