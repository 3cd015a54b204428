"""Suites: which scenes, how many frames, how large; rendered once and kept in the cache."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import cache_root
from hwp_bench.run.engine import Engine, LocalEngine, Needs
from hwp_bench.sim.scene import Scene, load_scene, scene_names


@dataclass(frozen=True)
class SuiteItem:
    """One capture of a suite."""

    #: The scene.
    scene: Scene
    #: Frames over which it is spread.
    frame_count: int
    #: Edge of the picture in pixels.
    size: int
    #: Seed of the scene.
    seed: int


# One single-hand and one interacting capture for each perturbation: interaction 0 and 5,
# complex poses 1 and 6, illumination 2 and 7, motion blur 3 and 4.
_MINI = tuple(f"capture{number}" for number in range(8))
# Captures, frames (None: the paper's) and size of each suite.
_SUITES: Mapping[str, tuple[tuple[str, ...] | None, int | None, int]] = MappingProxyType(
    {
        "smoke": (("capture0", "capture4"), 30, 112),
        "mini": (_MINI, 60, 176),
        "full": (None, None, 256),
    }
)


def suite_names() -> tuple[str, ...]:
    """Names of the suites, smallest first."""
    return tuple(_SUITES)


def suite(name: str) -> tuple[SuiteItem, ...]:
    """Return the captures of a suite.

    Args:
        name: `smoke` (seconds), `mini` (minutes) or `full` (hours).

    Raises:
        UsageError: there is no such suite.
    """
    if name not in _SUITES:
        raise UsageError(f"there is no suite {name!r}", remedy=f"Known: {', '.join(_SUITES)}.")
    captures, frame_count, size = _SUITES[name]
    scenes = [load_scene(capture) for capture in captures or scene_names()]
    return tuple(
        SuiteItem(scene, frame_count or scene.frame_count, size, scene.seed) for scene in scenes
    )


def ensure_suite(
    name: str,
    cache: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    *,
    engine: Engine | None = None,
    needs: Needs | None = None,
) -> list[Path]:
    """Render the captures of a suite that are not in the cache yet.

    Args:
        name: a suite.
        cache: folder of captures; the toolkit's cache if None.
        workers: processes for each render.
        engine: where captures are rendered; one after another in this process if None.
        needs: what one render takes of a machine.

    Returns:
        The capture folders, in the suite's order.

    Raises:
        UsageError: there is no such suite.
        HwpError: a render failed; captures that were finished stay.
    """
    from hwp_bench.sim.jobs import RenderCapture, render_job, workers_each
    from hwp_bench.sim.production import render_key

    engine, needs = engine or LocalEngine(), needs or Needs()
    root = Path(cache) if cache is not None else cache_root() / "sim" / "captures"
    each = workers_each(workers, engine, needs)
    jobs = []
    for item in suite(name):
        key = render_key(item.scene, item.frame_count, item.size)
        folder = root / f"{item.scene.id}-{item.frame_count}x{item.size}-{key[:12]}"
        work = RenderCapture(
            item.scene, item.frame_count, item.size, item.seed, workers=each, keep=True
        )
        jobs.append(render_job(work, folder, needs))
    if not all(job.finished() for job in jobs):
        engine.run(jobs, lambda index: None)
    return [job.output for job in jobs]
