"""Renders of captures as jobs of an engine."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base.errors import HwpError
from hwp_bench.run.engine import Engine, Job, Needs
from hwp_bench.run.engine.job import OnProgress
from hwp_bench.sim.scene import Scene

#: Seconds between two counts of the frames that wait.
_COUNT_SECONDS = 1.0


@dataclass(frozen=True)
class RenderCapture:
    """Renders a capture, in any process on any machine; the fields are `render_capture`'s."""

    #: The scene.
    scene: Scene
    #: Frames over which it is spread.
    frame_count: int | None = None
    #: Edge of the picture in pixels.
    size: int | None = None
    #: Seed; the scene's own if None.
    seed: int | None = None
    #: Processes of one render; as many as pay if None.
    workers: int | None = None
    #: Whether linear layers are stored too.
    exr: bool = False
    #: Whether a capture that is there already is taken as it is.
    keep: bool = False
    #: Whether one that is there is replaced.
    overwrite: bool = False

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
        """Render into a folder, or take what is there where that is wanted.

        Raises:
            HwpError: as `render_capture`.
        """
        from hwp_bench.base.locks import exclusive

        if not self.keep:
            self._render(output)
            return
        with exclusive(output, wait=True):
            if not is_capture(output):
                self._render(output)

    def _render(self, output: Path) -> None:
        from hwp_bench.sim.production import render_capture

        render_capture(
            self.scene,
            output,
            frame_count=self.frame_count,
            size=self.size,
            seed=self.seed,
            workers=self.workers,
            overwrite=self.keep or self.overwrite,
            exr=self.exr,
        )

    def _count(self, output: Path, on_progress: OnProgress, ended: threading.Event) -> None:
        """Tell how many frames wait beside the capture to be."""
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
        finished=lambda: work.keep and is_capture(output),
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
    """Return the processes of one render: what was asked for, else what an engine leaves it.

    In turn each render takes as many as pay; where several run at once, the processors of a job.
    """
    return workers if workers is not None or engine.in_turn else max(1, int(needs.cpus))
