"""Memory and time of a clip of 2,000 frames against one of half as many.

Run from the repository: `python -m benchmarks.long_clips [--frames 2000] [--size 32]`.
Each part runs in a process of its own, whose processor time and largest memory are read when it
ends; what Python and its packages take before the first frame is in the memory. Parts that go
frame by frame must have a ratio of memory near 1; a ratio of time near 2, or below where the start
counts, is linear. Other work on the machine changes processor times of tenths of a second by half.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hwp_bench.base.tables import Column, Table, to_markdown
from hwp_bench.capture import Cameras, CaptureInfo, CaptureWriter, HandModelId, open_capture
from hwp_bench.hands.skeleton import HandParameters

Part = Callable[[Path, int, int], None]


def write(path: Path, frames: int, size: int) -> None:
    """A textured disc that moves before noise, as a capture."""
    rng = np.random.default_rng(0)
    severities = tuple(3 if f % 4 == 1 and f < frames * 9 // 10 else 0 for f in range(frames))
    info = CaptureInfo(
        id="long",
        hands="right",
        action="Waving",
        device="Test",
        fps=30.0,
        width=size,
        height=size,
        frame_count=frames,
        hand_model=HandModelId("anny-1", "0" * 64),
        perturbations={"motion_blur": severities},
        source={"kind": "test"},
        licence="CC0",
    )
    K = np.array([[size * 0.9, 0, size / 2], [0, size * 0.9, size / 2], [0, 0, 1.0]])
    cameras = Cameras(np.repeat(K[None], frames, 0), np.repeat(np.eye(4)[None], frames, 0))
    hand = HandParameters(
        pose=rng.normal(0.0, 0.1, (frames, 16, 3)),
        betas=np.zeros(10),
        transl=np.tile([0.0, 0.0, 0.5], (frames, 1)),
        valid=np.ones(frames, dtype=bool),
    )
    rows, columns = np.mgrid[:size, :size]
    with CaptureWriter(path, info, {"right": hand}, cameras) as writer:
        for frame in range(frames):
            centre = size * (0.4 + 0.2 * frame / frames)
            inside = (rows - size / 2) ** 2 + (columns - centre) ** 2 < (size * 0.3) ** 2
            picture = rng.integers(0, 256, (size, size, 3), dtype=np.uint8)
            writer.frame(frame, picture)
            writer.mask(frame, (inside * 255).astype(np.uint8))


def check(path: Path, frames: int, size: int) -> None:
    """What `hwp-bench data check` does."""
    from hwp_bench.capture.check import check_capture

    check_capture(path)


def score(path: Path, frames: int, size: int) -> None:
    """Every frame against itself in the metrics without weights, read as it is scored."""
    from hwp_bench.metrics.score import score_frame

    capture = open_capture(path)
    for frame in range(frames):
        image = capture.frame(frame)
        score_frame(image, image, capture.mask(frame))


def pose(path: Path, frames: int, size: int) -> None:
    """The hand of every frame, frame by frame."""
    import torch

    from hwp_bench.hands import load_template, pose_hand

    hand = open_capture(path).hands["right"]
    template = load_template("anny", "right").to_torch()
    with torch.no_grad():
        for frame in range(frames):
            values = (hand.pose[frame : frame + 1], hand.betas, hand.transl[frame : frame + 1])
            pose_hand(template, *(torch.as_tensor(value, dtype=torch.float32) for value in values))


PARTS: dict[str, Part] = {"write": write, "check": check, "score": score, "pose": pose}


def _measure(name: str, path: Path, frames: int, size: int, queue: object) -> None:
    start = time.process_time()
    PARTS[name](path, frames, size)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    queue.put((time.process_time() - start, peak))  # type: ignore[attr-defined]


def measure(name: str, path: Path, frames: int, size: int) -> tuple[float, float]:
    """Processor seconds and the largest memory, MB, of a part in a fresh process."""
    context = multiprocessing.get_context("spawn")
    queue = context.SimpleQueue()
    process = context.Process(target=_measure, args=(name, path, frames, size, queue))
    process.start()
    process.join()
    if process.exitcode != 0:
        raise SystemExit(f"{name} ended with status {process.exitcode}")
    return queue.get()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--size", type=int, default=32, help="edge of the frames, px")
    options = parser.parse_args()
    counts = (options.frames // 2, options.frames)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in PARTS:
            (t1, m1), (t2, m2) = (
                measure(name, Path(folder) / str(count), count, options.size) for count in counts
            )
            rows.append((name, t1, t2, t2 / t1, m1, m2, m2 / m1))
    seconds = [Column(f"s at {count}", 2) for count in counts]
    memory = [Column(f"MB at {count}", 0) for count in counts]
    columns = (Column("part"), *seconds, Column("ratio"), *memory, Column("ratio"))
    print(to_markdown(Table("Long clips", columns, tuple(rows), ranked=False)))


if __name__ == "__main__":
    main()
