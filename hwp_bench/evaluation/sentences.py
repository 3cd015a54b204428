"""A result in words: what it lacks of the suite that it names, its failures and doubts.

Every bad frame is named, up to a number, with a count.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hwp_bench.capture.schema import CaptureInfo
from hwp_bench.capture.splits import split_for
from hwp_bench.evaluation.scoring import read_warnings
from hwp_bench.results import CaptureResult, FrameResult, Results
from hwp_bench.results.schema import isolation_text
from hwp_bench.run.worker import LOG
from hwp_bench.sim.produce.capture import SuiteItem, suite

#: Most frames that are named of a capture; the others are counted.
SHOWN = 12


def outcome_lines(out: Path, results: Results, head: str = "") -> list[str]:
    """Return a line for each failure, log and doubt of an evaluation, and one for its isolation."""
    lines = []
    for capture in results.captures:
        folder = out / "captures" / capture.id
        lines += [
            f"failed: {head}{text}"
            for text in (failure_text(capture), free_view_text(capture))
            if text
        ]
        if capture.failure and (folder / LOG).is_file():
            lines.append(f"log: {folder / LOG}")
        lines += [f"warning: {head}{capture.id}: {text}" for text in read_warnings(folder)]
    return lines + [
        text for text in (times_text(results, head), isolation_text(results, head)) if text
    ]


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


# --- the suite


def find_missing(results: Results) -> list[str]:
    """Return what results lack of their suite, in words; empty where they are complete.

    Every capture of the suite must be there under its name, with the suite's own split and every
    test frame, whether it was predicted or failed.
    """
    items = {item.scene.id: item for item in suite(results.suite)}
    given = {capture.id: capture for capture in results.captures}
    problems = find_other_captures(results)
    for name in sorted(items.keys() & given.keys()):
        split = split_for(name, items[name].frame_count)
        if given[name].split_digest != split.digest:
            problems.append(f"{name}: is split otherwise than the suite")
        elif [frame.frame for frame in given[name].frames] != split.test.tolist():
            problems.append(f"{name}: lacks test frames")
    return problems


def find_other_captures(results: Results) -> list[str]:
    """Return in words which captures of its suite a result lacks or has too many."""
    problems = []
    items = {item.scene.id for item in suite(results.suite)}
    given = {capture.id for capture in results.captures}
    if absent := sorted(items - given):
        problems.append(f"lacks {len(absent)} of {len(items)} captures: {', '.join(absent)}")
    if foreign := sorted(given - items):
        problems.append(f"has captures that are not of the suite: {', '.join(foreign)}")
    if len(given) != len(results.captures):
        problems.append("has a capture twice")
    return problems


def find_wrong_labels(results: Results) -> list[str]:
    """Return in words which labels of captures are not those of the suite's scenes.

    Labels decide which means a capture enters: hands, perturbations, and whether its masks are
    exact.
    """
    items = {item.scene.id: item for item in suite(results.suite)}
    problems = []
    for capture in results.captures:
        item = items.get(capture.id)
        labels: list[tuple[str, object, object]] = (
            []
            if item is None
            else [
                ("hands", capture.hands, item.scene.hands),
                ("perturbations", sorted(capture.perturbations), declared_perturbations(item)),
                ("exact_masks", capture.exact_masks, True),
            ]
        )
        for name, found, wanted in labels:
            if found != wanted:
                problems.append(f"{capture.id}: {name} {found!r} where the suite has {wanted!r}")
    return problems


def declared_perturbations(item: SuiteItem) -> list[str]:
    """Return the perturbations that a capture of the suite declares, by name."""
    return sorted({call.kind for call in item.scene.effects})


def is_of_suite(info: CaptureInfo, name: str) -> bool:
    """Return whether a capture was rendered from its scene of a suite, at the suite's size."""
    return any(
        (info.id, info.frame_count, info.width, info.height)
        == (item.scene.id, item.frame_count, item.size, item.size)
        and info.source.get("scene_digest") == item.scene.digest
        for item in suite(name)
    )
