"""Rendered frames before their capture is whole: one file each, written by one or more processes.

An interrupted render continues where it stopped, because finished frames are kept.
"""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hwp_bench.base.arrays import read_npz
from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.base.files import atomic_write
from hwp_bench.run.engine.job import OnProgress
from hwp_bench.run.engine.processes import THREADS, LocalJob, Stopped, WorkerLost, run_in_process
from hwp_bench.sim.render.frame import render_frame
from hwp_bench.sim.render.layers import write_layers
from hwp_bench.sim.scene.schema import Scene

_REMEDY = "Finished frames are kept; the same command continues from there."


def frame_file(folder: Path, frame: int) -> Path:
    """Path of a rendered frame."""
    return folder / f"{frame:06d}.npz"


def exr_file(folder: Path, frame: int) -> Path:
    """Path of the linear layers of a rendered frame."""
    return folder / f"{frame:06d}.exr"


def read_frame(folder: Path, frame: int) -> dict[str, np.ndarray] | None:
    """Read a rendered frame; None if it is missing or damaged."""
    try:
        return read_npz(frame_file(folder, frame))
    except BadInput:
        return None


def eight_bit_coverage(coverage: np.ndarray) -> np.ndarray:
    """Coverage 0-1 in 8 bits, rounded down: 255 means that the hand covers the pixel fully."""
    return np.floor(255.0 * coverage + 1e-3).astype(np.uint8)


def render_frames(
    scene: Scene,
    frames: Iterable[int],
    frame_count: int,
    size: int,
    folder: Path,
    exr: bool = False,
) -> None:
    """Render frames into a folder.

    Args:
        scene: the scene.
        frames: which.
        frame_count: frames over which the capture is spread.
        size: edge of the image in pixels.
        folder: where they go.
        exr: also write linear layers as EXR.
    """
    for frame in frames:
        result = render_frame(scene, frame, frame_count, size)
        cost = {
            "seconds": dict(result.cost.seconds),
            "rays": dict(result.cost.rays),
            "subframes": result.plan.subframes,
        }
        buffer = io.BytesIO()
        np.savez(
            buffer,
            rgb=result.rgb,
            clean=result.clean,
            coverage=result.coverage.astype(np.float32),
            clean_coverage=result.clean_coverage.astype(np.float32),
            cost=np.frombuffer(json.dumps(cost).encode(), dtype=np.uint8),
        )
        if exr:
            write_layers(exr_file(folder, frame), scene, result, frame_count, size)
        # Last: the frame counts as rendered only when all of it is there.
        atomic_write(frame_file(folder, frame), buffer.getvalue())


@dataclass(frozen=True)
class RenderFrames:
    """Renders frames into a folder: the work of one process. Fields as in `render_frames`."""

    #: The scene.
    scene: Scene
    #: Numbers of the frames.
    frames: Sequence[int]
    #: Frames over which the capture is spread.
    frame_count: int
    #: Edge of the image in pixels.
    size: int
    #: Whether linear layers are written too.
    exr: bool

    def __call__(self, inputs: Mapping[str, Path], output: Path, on_progress: OnProgress) -> None:
        """Render; see `hwp_bench.run.engine.job.Work`."""
        for done, frame in enumerate(self.frames, start=1):
            render_frames(self.scene, [frame], self.frame_count, self.size, output, self.exr)
            on_progress(done, len(self.frames))


def render_in_processes(
    works: Sequence[RenderFrames], folder: Path, on_progress: Callable[[int], None]
) -> None:
    """Render frames in as many processes as there are works; if one fails, all are ended.

    Args:
        works: the frames of each process.
        folder: where the frames go.
        on_progress: is told how many frames are finished.

    Raises:
        HwpError: a process failed or was killed.
    """
    stop = threading.Event()
    done = [0] * len(works)

    def run(index: int) -> None:
        def count(steps: int, total: int) -> None:
            done[index] = steps
            on_progress(sum(done))

        # One thread each: the processes share the processors.
        job = LocalJob(works[index], {}, folder.absolute(), dict.fromkeys(THREADS, "1"))
        try:
            run_in_process(job, count, stop.is_set)
        except BaseException:
            stop.set()
            raise

    with ThreadPoolExecutor(len(works)) as pool:
        futures = [pool.submit(run, index) for index in range(len(works))]
        try:
            while wait(futures, timeout=1.0).not_done:
                pass  # a wait without end would not let Ctrl-C through on every system
        finally:
            stop.set()
    for error in (future.exception() for future in futures):
        if isinstance(error, WorkerLost):
            problem = f"a rendering process was killed ({error})"
            raise HwpError(problem, where=works[0].scene.id, remedy=_REMEDY) from error
        if isinstance(error, HwpError):
            raise type(error)(
                error.problem,
                where=error.where,
                field=error.field,
                remedy=error.remedy or _REMEDY,
            ) from error
        if error is not None and not isinstance(error, Stopped):
            raise error
