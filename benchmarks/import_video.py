"""Seconds of `hwp-bench data import video`, next to OpenCV's GrabCut of the same frames.

Run from the repository: `python -m benchmarks.import_video [VIDEO --landmarks NPZ]`. Without a
video the frames of a simulated capture become one, and the landmarks are those of its true hand.
The reference is what a person would try first: GrabCut of each stored frame from a rectangle, in
five iterations, without a hand model. The budget for 621 frames is 150 s on two cores.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks.small_capture import small_capture
from hwp_bench.capture import Capture, open_capture
from hwp_bench.hands import load_template, pose_hand
from hwp_bench.importers.video import VideoImport, import_video

#: Seconds that 621 frames may take on two cores.
BUDGET, BUDGET_FRAMES = 150.0, 621
#: Frames of the simulated video, and their rate.
FRAMES, FPS = 60, 30.0


def make_video(folder: Path, capture: Capture) -> tuple[Path, Path]:
    """The first frames of a capture as a video, and the landmarks of its right hand."""
    video, landmarks = folder / "hand.avi", folder / "hand.npz"
    size = (capture.info.width, capture.info.height)
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), FPS, size)
    for frame in range(FRAMES):
        writer.write(np.ascontiguousarray(capture.frame(frame)[:, :, ::-1]))
    writer.release()
    hand = capture.hands["right"]
    posed = pose_hand(
        load_template(side="right").to_torch(torch.float64),
        torch.from_numpy(hand.pose[:FRAMES]),
        torch.from_numpy(hand.betas),
        torch.from_numpy(hand.transl[:FRAMES]),
    )
    viewmats = capture.cameras.viewmats[:FRAMES]
    points = posed.landmarks.numpy() @ viewmats[:, :3, :3].swapaxes(1, 2)
    points = points + viewmats[:, None, :3, 3]
    image = np.einsum("fij,fnj->fni", capture.cameras.Ks[:FRAMES], points)
    np.savez(
        landmarks,
        image=image[..., :2] / image[..., 2:],
        world=points - points.mean(axis=1, keepdims=True),
        score=np.ones(FRAMES),
    )
    return video, landmarks


def cut_frames(capture: Capture) -> None:
    """The reference: GrabCut of every frame from a rectangle, five iterations."""
    for frame in range(len(capture)):
        image = np.ascontiguousarray(capture.frame(frame))
        height, width = image.shape[:2]
        labels = np.zeros((height, width), np.uint8)
        inner = (width // 8, height // 8, width * 3 // 4, height * 3 // 4)
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(image, labels, inner, *models, 5, cv2.GC_INIT_WITH_RECT)


def spent(work: Callable[[], Any]) -> tuple[float, float]:
    """Seconds by the clock and of the processor, all threads together."""
    clock, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF)
    work()
    after = resource.getrusage(resource.RUSAGE_SELF)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - clock, processor


def race(video: Path | None, landmarks: Path | None) -> dict[str, float]:
    """Seconds and processor seconds of the import and of the reference, and the frames."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if video is None or landmarks is None:
            video, landmarks = make_video(folder, small_capture(frames=FRAMES))
        out = folder / "imported"
        ours = spent(lambda: import_video(video, landmarks, out, VideoImport()))
        capture = open_capture(out)
        reference = spent(lambda: cut_frames(capture))
        return {
            "frames": float(len(capture)),
            "import": ours[0],
            "import, processor": ours[1],
            "reference, processor": reference[1],
        }


def measure() -> Mapping[str, float]:
    """Return the processor time of an import of 60 frames over that of the reference."""
    found = race(None, None)
    return {"import / GrabCut": found["import, processor"] / found["reference, processor"]}


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("video", nargs="?", type=Path, help="a video of your own")
    parser.add_argument("--landmarks", type=Path, help="its landmarks")
    args = parser.parse_args()
    found = race(args.video, args.landmarks)
    count, processor = found["frames"], found["import, processor"]
    print(f"{count:.0f} frames: {found['import']:.1f} s, {processor:.1f} s of the processor")
    print(f"GrabCut of the same frames: {found['reference, processor']:.1f} s of the processor")
    print(f"ratio of processor time: {processor / found['reference, processor']:.2f}")
    allowed = BUDGET * max(1.0, count / BUDGET_FRAMES)
    print(f"budget: {allowed:.0f} s on two cores")
    return 0 if found["import"] <= allowed else 1


if __name__ == "__main__":
    sys.exit(main())
