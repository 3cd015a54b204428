"""A process that renders some frames of a capture into a folder; started by `production`.

Frames are kept as one file each, so that an interrupted render goes on where it stopped.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from hwp_bench.base.arrays import read_npz
from hwp_bench.base.errors import BadInput
from hwp_bench.base.files import atomic_write
from hwp_bench.sim.scene.schema import Scene


def frame_file(folder: Path, frame: int) -> Path:
    """Where a rendered frame waits."""
    return folder / f"{frame:06d}.npz"


def exr_file(folder: Path, frame: int) -> Path:
    """Where the linear layers of a rendered frame wait."""
    return folder / f"{frame:06d}.exr"


def read_frame(folder: Path, frame: int) -> dict[str, np.ndarray] | None:
    """Read a rendered frame; None where there is none or it is damaged."""
    try:
        return read_npz(frame_file(folder, frame))
    except BadInput:
        return None


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
        size: edge of the picture in pixels.
        folder: where they go.
        exr: also write linear layers as EXR.
    """
    from hwp_bench.sim.render.frame import render_frame
    from hwp_bench.sim.render.layers import write_layers

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


def main() -> int:
    """Read one job from standard input and do it."""
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    import torch

    torch.set_num_threads(1)
    # The job comes from our own parent process through a pipe.
    scene, frames, frame_count, size, folder, exr = pickle.load(sys.stdin.buffer)
    parent = os.getppid()
    for frame in frames:
        if os.getppid() != parent:
            return 1  # whoever asked for the frames is gone
        render_frames(scene, [frame], frame_count, size, Path(folder), exr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
