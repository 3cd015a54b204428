"""A suite by its name: its captures, how they come to be there, and what a result lacks of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Protocol

from hwp_bench.capture.schema import CaptureInfo
from hwp_bench.capture.splits import split_for
from hwp_bench.results import Results
from hwp_bench.run.engine import Engine, Needs
from hwp_bench.sim.produce import capture as simulated
from hwp_bench.suites.real import ensure_clips, read_clips
from hwp_bench.taxonomy import REAL_SUITES


class SuiteCapture(Protocol):
    """One capture of a suite: a scene to render, or a real clip to import."""

    @property
    def id(self) -> str:
        """Id of the capture."""

    @property
    def shows(self) -> str:
        """One line that describes it."""

    @property
    def hands(self) -> str:
        """`right`, `left` or `both`."""

    @property
    def frame_count(self) -> int:
        """Frames."""

    @property
    def size(self) -> int:
        """Edge of the image, px."""

    @property
    def perturbations(self) -> Sequence[str]:
        """Names of the perturbations that it declares."""

    @property
    def exact_masks(self) -> bool:
        """Whether its scoring masks are exact coverage."""

    def is_source_of(self, info: CaptureInfo) -> bool:
        """Return whether a capture was made of this scene or clip, as the suite has it."""


def suite(name: str) -> Sequence[SuiteCapture]:
    """Return the captures of a suite; nothing is rendered or downloaded.

    Raises:
        UsageError: there is no such suite.
    """
    return read_clips(name) if name in REAL_SUITES else simulated.suite(name)


def ensure_suite(
    name: str, *, engine: Engine | None = None, needs: Needs | None = None
) -> list[Path]:
    """Render or import the captures of a suite that are not in the cache yet.

    Args:
        name: the suite.
        engine: where captures are rendered; real clips are imported in this process.
        needs: what one render takes of a machine.

    Returns:
        The capture folders, in the suite's order. Real clips that are not available are left out by
        name.

    Raises:
        UsageError: there is no such suite.
        HwpError: a capture cannot be made; those that were finished stay.
    """
    if name in REAL_SUITES:
        return ensure_clips(name)[0]
    return simulated.ensure_suite(name, engine=engine, needs=needs)


def is_ready(name: str) -> bool:
    """Whether every capture of a suite is in the cache."""
    if name in REAL_SUITES:
        return all(clip.is_whole() for clip in read_clips(name))
    return simulated.is_rendered(name)


@cache
def suite_scenes(name: str) -> Mapping[str, str]:
    """Return what the captures of a suite are made of: digests of scenes or clips by id."""
    if name in REAL_SUITES:
        return {clip.id: clip.origin for clip in read_clips(name)}
    return {item.id: item.scene.digest for item in simulated.suite(name)}


# --- what a result lacks


def find_missing(results: Results) -> list[str]:
    """Return what results lack of their suite, in words; empty where they are complete.

    Every capture of the suite must be there under its name, with the suite's own split and every
    test frame, whether it was predicted or failed.
    """
    items = {item.id: item for item in suite(results.suite)}
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
    items = {item.id for item in suite(results.suite)}
    given = {capture.id for capture in results.captures}
    if absent := sorted(items - given):
        problems.append(f"lacks {len(absent)} of {len(items)} captures: {', '.join(absent)}")
    if foreign := sorted(given - items):
        problems.append(f"has captures that are not of the suite: {', '.join(foreign)}")
    if len(given) != len(results.captures):
        problems.append("has a capture twice")
    return problems


def lost_clips(results: Results) -> list[str]:
    """Return in words which real clips of its suite a result lacks.

    A machine may not get all of them, where it renders every capture of a simulated suite.
    """
    return find_other_captures(results) if results.suite in REAL_SUITES else []


def find_wrong_labels(results: Results) -> list[str]:
    """Return in words which labels of captures are not those of the suite.

    Labels decide which means a capture enters: hands, perturbations, and whether its masks are
    exact.
    """
    items = {item.id: item for item in suite(results.suite)}
    problems = []
    for capture in results.captures:
        item = items.get(capture.id)
        labels: list[tuple[str, object, object]] = (
            []
            if item is None
            else [
                ("hands", capture.hands, item.hands),
                ("perturbations", sorted(capture.perturbations), sorted(item.perturbations)),
                ("exact_masks", capture.exact_masks, item.exact_masks),
            ]
        )
        for name, found, wanted in labels:
            if found != wanted:
                problems.append(f"{capture.id}: {name} {found!r} where the suite has {wanted!r}")
    return problems


def is_of_suite(info: CaptureInfo, name: str) -> bool:
    """Return whether a capture was made of a scene or clip of a suite, as the suite has it."""
    return any(item.is_source_of(info) for item in suite(name))
