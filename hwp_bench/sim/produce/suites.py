"""Suites: which scenes, how many frames, how large; rendered once, as jobs, into the cache."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

from hwp_bench.base.errors import HwpError, UsageError
from hwp_bench.base.files import cache_root
from hwp_bench.base.folders import exclusive
from hwp_bench.run.engine import Engine, Job, LocalEngine, Needs
from hwp_bench.run.engine.job import OnProgress
from hwp_bench.sim.scene.reader import load_scene, scene_groups, scene_names
from hwp_bench.sim.scene.schema import Scene

#: Seconds between two counts of the frames that wait.
_COUNT_SECONDS = 1.0


@dataclass(frozen=True)
class SuiteItem:
    """One capture of a suite."""

    #: The scene.
    scene: Scene
    #: Frames over which it is spread.
    frame_count: int
    #: Edge of the image in pixels.
    size: int
    #: Seed of the scene.
    seed: int


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
        SuiteItem(scene, rule.frames or -(-scene.frame_count // rule.every), rule.size, scene.seed)
        for scene in scenes
    )


def ensure_suite(
    name: str,
    cache: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    *,
    engine: Engine | None = None,
    needs: Needs | None = None,
    free_view: bool = True,
) -> list[Path]:
    """Render the captures of a suite that are not in the cache yet.

    Args:
        name: a suite.
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
    return ensure_captures(
        suite(name), cache, workers, engine=engine, needs=needs, free_view=free_view
    )


def ensure_captures(
    items: Sequence[SuiteItem],
    cache: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    *,
    engine: Engine | None = None,
    needs: Needs | None = None,
    free_view: bool = True,
) -> list[Path]:
    """Render captures that are not in the cache yet, such as some of a suite.

    Args:
        items: the captures.
        cache: folder of captures; the toolkit's cache if None.
        workers: processes for each render.
        engine: where captures are rendered; one after another in this process if None.
        needs: what one render takes of a machine.
        free_view: also render free-view clips, which captures in the cache may lack.

    Returns:
        The capture folders, in the order of `items`.

    Raises:
        HwpError: a render failed; captures that were finished stay.
    """
    engine = engine or LocalEngine()
    jobs = _render_jobs(items, cache, workers, engine, needs or Needs(), free_view=free_view)
    if not all(job.finished() for job in jobs):
        engine.run(jobs, lambda index: None)
    return [job.output for job in jobs]


def is_rendered(name: str, cache: str | os.PathLike[str] | None = None) -> bool:
    """Whether every capture of a suite is in the cache.

    Raises:
        UsageError: there is no such suite.
    """
    jobs = _render_jobs(suite(name), cache, None, LocalEngine(), Needs(), free_view=True)
    return all(job.finished() for job in jobs)


def _render_jobs(
    items: Sequence[SuiteItem],
    cache: str | os.PathLike[str] | None,
    workers: int | None,
    engine: Engine,
    needs: Needs,
    *,
    free_view: bool,
) -> list[Job]:
    from hwp_bench.sim.produce.production import render_key

    root = Path(cache) if cache is not None else cache_root() / "sim" / "captures"
    each = workers_each(workers, engine, needs)
    jobs = []
    for item in items:
        key = render_key(item.scene, item.frame_count, item.size)
        folder = root / f"{item.scene.id}-{item.frame_count}x{item.size}-{key[:12]}"
        work = RenderCapture(
            item.scene,
            item.frame_count,
            item.size,
            item.seed,
            workers=each,
            keep=True,
            free_view=free_view,
        )
        jobs.append(render_job(work, folder, needs))
    return jobs


@dataclass(frozen=True)
class RenderCapture:
    """Renders a capture, in any process on any machine; the fields are `render_capture`'s."""

    #: The scene.
    scene: Scene
    #: Frames over which it is spread.
    frame_count: int | None = None
    #: Edge of the image in pixels.
    size: int | None = None
    #: Seed; the scene's own if None.
    seed: int | None = None
    #: Processes of one render; as many as are worth it if None.
    workers: int | None = None
    #: Whether linear layers are stored too.
    exr: bool = False
    #: Whether a capture that exists already is used as it is.
    keep: bool = False
    #: Whether one that is there is replaced.
    overwrite: bool = False
    #: Whether the free-view clip is rendered too.
    free_view: bool = True

    def __call__(self, inputs: Mapping[str, Path], output: Path, on_progress: OnProgress) -> None:
        """Render; see `hwp_bench.run.engine.job.Work`."""
        ended = threading.Event()
        watch = threading.Thread(target=self._count, args=(output, on_progress, ended), daemon=True)
        watch.start()
        try:
            self.render(output)
        finally:
            ended.set()
            watch.join()

    def render(self, output: Path) -> None:
        """Render into a folder, or use the capture that exists there if `keep` says so.

        The free-view clip of a capture that exists is rendered where it is missing.

        Raises:
            HwpError: as `render_capture`.
        """
        if not self.keep:
            self._render(output)
            return
        with exclusive(output, wait=True):
            if not is_capture(output):
                self._render(output)
            elif not self.complete(output):
                from hwp_bench.capture import open_capture
                from hwp_bench.sim.produce.free_view import add_free_view

                add_free_view(self._scene(), open_capture(output))

    def complete(self, output: Path) -> bool:
        """Whether a folder holds a capture with all that is asked for."""
        if not is_capture(output) or not self.free_view:
            return is_capture(output)
        from hwp_bench.sim.produce.free_view import has_free_view

        return has_free_view(output)

    def _scene(self) -> Scene:
        return self.scene if self.seed is None else replace(self.scene, seed=self.seed)

    def _render(self, output: Path) -> None:
        from hwp_bench.sim.produce.production import render_capture

        render_capture(
            self.scene,
            output,
            frame_count=self.frame_count,
            size=self.size,
            seed=self.seed,
            workers=self.workers,
            overwrite=self.keep or self.overwrite,
            exr=self.exr,
            free_view=self.free_view,
        )

    def _count(self, output: Path, on_progress: OnProgress, ended: threading.Event) -> None:
        """Report how many frames of the unfinished capture exist."""
        total = self.frame_count or self.scene.frame_count
        while not ended.wait(_COUNT_SECONDS):
            on_progress(sum(1 for _ in output.parent.glob(f".{output.name}.*/*.npz")), total)


def render_job(work: RenderCapture, output: Path, needs: Needs) -> Job:
    """Return a render as a job of an engine.

    Args:
        work: what to render.
        output: the capture folder to make.
        needs: what it takes of a machine.
    """
    return Job(
        text=work.scene.id,
        # In turn, a render shows its own progress.
        here=lambda on_progress: work.render(output),
        work=work,
        output=output,
        finished=lambda: work.keep and work.complete(output),
        needs=needs,
    )


def is_capture(folder: Path) -> bool:
    """Whether a folder holds a capture that can be opened."""
    from hwp_bench.capture import open_capture

    try:
        open_capture(folder)
    except HwpError:
        return False
    return True


def workers_each(workers: int | None, engine: Engine, needs: Needs) -> int | None:
    """Return the processes of one render: as asked for, else as many as the engine allows.

    In turn each render takes as many as are worth it; where several run at once, the processors
    of a job.
    """
    return workers if workers is not None or engine.in_turn else max(1, int(needs.cpus))
