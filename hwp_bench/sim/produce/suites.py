"""Suites: which scenes, how many frames, how large; rendered once, as jobs, into the cache."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import cache_root
from hwp_bench.run.engine import Engine, LocalEngine, Needs
from hwp_bench.sim.produce.capture import RenderRequest, render_key
from hwp_bench.sim.scene.scene import Scene
from hwp_bench.sim.scene_files import load_scene, scene_groups, scene_names


@dataclass(frozen=True)
class SuiteItem:
    """One capture of a suite."""

    #: The scene.
    scene: Scene
    #: Frames over which it is spread.
    frame_count: int
    #: Edge of the image in pixels.
    size: int


# One single-hand and one interacting capture for each perturbation: interaction 0 and 5,
# complex poses 1 and 6, illumination 2 and 7, motion blur 3 and 4.
_MINI = tuple(f"capture{number}" for number in range(8))


@dataclass(frozen=True)
class _Rule:
    """How a suite is made of scenes."""

    #: Edge of the image, px.
    size: int
    #: Frames of each capture, over the same motions; None: by the paper's number and `every`.
    frames: int | None = None
    #: The captures; None: all of the group of scenes with the suite's name, or the eleven.
    captures: tuple[str, ...] | None = None
    #: Without `frames`: how many of the paper's frames stand for one of the suite's.
    every: int = 1


_SUITES: Mapping[str, _Rule] = MappingProxyType(
    {
        "smoke": _Rule(112, 30, ("capture0", "capture4")),
        "mini": _Rule(176, 60, _MINI),
        "full-lite": _Rule(256, every=12),
        "full": _Rule(256),
        "wild-dev": _Rule(176, 60),
        "wild-test": _Rule(176, 60),
    }
)


def suite_names() -> tuple[str, ...]:
    """Names of the suites: those of the paper's captures, smallest first, then the wild ones."""
    return tuple(_SUITES)


def suite(name: str) -> tuple[SuiteItem, ...]:
    """Return the captures of a suite.

    Args:
        name: `smoke` (seconds), `mini` (minutes), `full` (hours), `full-lite` (a twelfth
            of its frames), or of scenes that are as wide as the world: `wild-dev` (for tuning)
            or `wild-test` (for reports only).

    Raises:
        UsageError: there is no such suite.
    """
    if name not in _SUITES:
        raise UsageError(f"there is no suite {name!r}", remedy=f"Known: {', '.join(_SUITES)}.")
    rule = _SUITES[name]
    group = name if name in scene_groups() else ""
    scenes = [load_scene(capture) for capture in rule.captures or scene_names(group)]
    return tuple(
        SuiteItem(scene, rule.frames or -(-scene.frame_count // rule.every), rule.size)
        for scene in scenes
    )


def ensure_suite(
    name: str | Sequence[SuiteItem],
    cache: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    *,
    engine: Engine | None = None,
    needs: Needs | None = None,
    free_view: bool = True,
) -> list[Path]:
    """Render the captures of a suite that are not in the cache yet.

    Args:
        name: a suite, or captures such as some of one.
        cache: folder of captures; the toolkit's cache if None.
        workers: processes for each render.
        engine: where captures are rendered; one after another in this process if None.
        needs: what one render takes of a machine.
        free_view: also render free-view clips, which captures in the cache may lack.

    Returns:
        The capture folders, in the suite's order.

    Raises:
        UsageError: there is no such suite.
        HwpError: a render failed; captures that were finished stay.
    """
    engine, needs = engine or LocalEngine(), needs or Needs()
    items = suite(name) if isinstance(name, str) else name
    each = workers_each(workers, engine, needs)
    jobs = [
        RenderRequest(
            item.scene, item.frame_count, item.size, workers=each, keep=True, free_view=free_view
        ).job(_folder(item, cache), needs)
        for item in items
    ]
    if not all(job.finished() for job in jobs):
        engine.run(jobs, lambda index: None)
    return [job.output for job in jobs]


def is_rendered(name: str, cache: str | os.PathLike[str] | None = None) -> bool:
    """Whether every capture of a suite is in the cache, with its free-view clip."""
    return all(
        RenderRequest(item.scene, item.frame_count, item.size, keep=True).is_whole(
            _folder(item, cache)
        )
        for item in suite(name)
    )


def _folder(item: SuiteItem, cache: str | os.PathLike[str] | None) -> Path:
    """Where a capture lies in the cache."""
    root = Path(cache) if cache is not None else cache_root() / "sim" / "captures"
    key = render_key(item.scene, item.frame_count, item.size)
    return root / f"{item.scene.id}-{item.frame_count}x{item.size}-{key[:12]}"


def workers_each(workers: int | None, engine: Engine, needs: Needs) -> int | None:
    """Return the processes of one render: as asked for, else as many as the engine allows.

    In turn each render takes as many as are worth it; where several run at once, the processors
    of a job.
    """
    return workers if workers is not None or engine.in_turn else max(1, int(needs.cpus))
