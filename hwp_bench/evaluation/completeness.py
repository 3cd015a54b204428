"""Whether a result is of the whole suite that it names, and of that suite's scenes."""

from __future__ import annotations

from hwp_bench.capture.schema import CaptureInfo
from hwp_bench.capture.splits import split_for
from hwp_bench.results import CaptureResult, Results
from hwp_bench.sim.produce.suites import SuiteItem, suite


def missing(results: Results) -> list[str]:
    """Return what results lack of their suite, in words; empty where they are complete.

    Every capture of the suite must be there under its name, with the suite's own split and every
    test frame, whether it was predicted or failed.
    """
    items = {item.scene.id: item for item in suite(results.suite)}
    given = {capture.id: capture for capture in results.captures}
    problems = other_captures(results)
    for name in sorted(items.keys() & given.keys()):
        split = split_for(name, items[name].frame_count)
        if given[name].split_digest != split.digest:
            problems.append(f"{name}: is split otherwise than the suite")
        elif [frame.frame for frame in given[name].frames] != split.test.tolist():
            problems.append(f"{name}: lacks test frames")
    return problems


def other_captures(results: Results) -> list[str]:
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


def wrong_labels(results: Results) -> list[str]:
    """Return in words which labels of captures are not those of the suite's scenes.

    Labels decide which means a capture enters: hands, perturbations, and whether its masks are
    exact.
    """
    items = {item.scene.id: item for item in suite(results.suite)}
    problems = []
    for capture in results.captures:
        if capture.id not in items:
            continue
        for name, found, wanted in _labels(capture, items[capture.id]):
            if found != wanted:
                problems.append(f"{capture.id}: {name} {found!r} where the suite has {wanted!r}")
    return problems


def _labels(capture: CaptureResult, item: SuiteItem) -> list[tuple[str, object, object]]:
    return [
        ("hands", capture.hands, item.scene.hands),
        ("perturbations", sorted(capture.perturbations), declared(item)),
        ("exact_masks", capture.exact_masks, True),
    ]


def declared(item: SuiteItem) -> list[str]:
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
