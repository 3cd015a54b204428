"""Track one hand in a video with MediaPipe; `hwp-bench data import video` reads the result.

Runs in its own environment, because MediaPipe pins old packages:

    python -m venv tracker && tracker/bin/pip install mediapipe==0.10.21 .
    tracker/bin/python tools/track_mediapipe.py hand.mp4 hand.npz --hand right

Version 0.10.21 is the newest that carries its models inside the package, so nothing is downloaded
while it runs. Frames are decoded as the import decodes them.

The result is an .npz with one row for every frame of the video: `image` (F, 21, 3), x and y in
pixels of the frame and z in the same unit; `world` (F, 21, 3) metres; `score` (F,), 0 where the
hand was not seen.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np

from hwp_bench.importers.video import decode

#: MediaPipe takes every image for a mirrored selfie: on other images its labels are swapped.
SWAPPED = {"Right": "left", "Left": "right"}


class Landmarker(Protocol):
    """The part of `mediapipe.solutions.hands.Hands` that is used."""

    def process(self, image: np.ndarray) -> Any:
        """Find hands in an RGB image."""


def track(frames: Iterator[np.ndarray], landmarker: Landmarker, hand: str) -> dict[str, np.ndarray]:
    """Track one hand.

    Args:
        frames: (H, W, 3) uint8 RGB, not mirrored.
        landmarker: finds the hands of an image.
        hand: `right`, `left`, or `any` for the one that is seen best.

    Returns:
        `image`, `world` and `score`, as described at the top of this file.
    """
    image, world, score = [], [], []
    for frame in frames:
        height, width = frame.shape[:2]
        points, places, seen = np.zeros((21, 3)), np.zeros((21, 3)), 0.0
        found = landmarker.process(frame)
        index = _choose(found, hand)
        if index is not None:
            seen = float(found.multi_handedness[index].classification[0].score)
            for row, point in enumerate(found.multi_hand_landmarks[index].landmark):
                points[row] = point.x * width, point.y * height, point.z * width
            for row, point in enumerate(found.multi_hand_world_landmarks[index].landmark):
                places[row] = point.x, point.y, point.z
        image.append(points)
        world.append(places)
        score.append(min(max(seen, 0.0), 1.0))
    return {"image": np.array(image), "world": np.array(world), "score": np.array(score)}


def _choose(found: Any, hand: str) -> int | None:
    """Index of the best hand of the given side, or None."""
    best = None
    for index in range(len(found.multi_hand_landmarks or ())):
        label = found.multi_handedness[index].classification[0]
        if hand != "any" and SWAPPED.get(label.label) != hand:
            continue
        if best is None or label.score > found.multi_handedness[best].classification[0].score:
            best = index
    return best


def read_frames(path: str) -> Iterator[np.ndarray]:
    """Yield the frames of a video as RGB."""
    return (frame for _, frame in decode.read_frames(decode.probe(path), decode.FrameRange()))


def write(path: str, tracked: dict[str, np.ndarray]) -> None:
    """Write the .npz, whole or not at all."""
    temporary = f"{path}.{os.getpid()}.tmp.npz"
    np.savez_compressed(temporary, **tracked)
    os.replace(temporary, path)


def main() -> int:
    """Run the program; returns the exit status."""
    parser = argparse.ArgumentParser(description="Track one hand in a video with MediaPipe.")
    parser.add_argument("video", help="any video that the toolkit reads, not mirrored")
    parser.add_argument("out", help=".npz to write")
    parser.add_argument("--hand", choices=("right", "left", "any"), default="any")
    parser.add_argument("--min-confidence", type=float, default=0.5)
    args = parser.parse_args()
    try:
        import mediapipe
    except ImportError:
        print("mediapipe is not installed; see the top of this file", file=sys.stderr)
        return 1
    with mediapipe.solutions.hands.Hands(
        max_num_hands=2,
        model_complexity=1,
        min_detection_confidence=args.min_confidence,
        min_tracking_confidence=args.min_confidence,
    ) as landmarker:
        tracked = track(read_frames(args.video), landmarker, args.hand)
    if not len(tracked["score"]):
        print(f"{args.video}: no frame can be decoded", file=sys.stderr)
        return 1
    write(args.out, tracked)
    seen = int((tracked["score"] > 0).sum())
    print(f"{args.out}: {len(tracked['score'])} frames, hand seen in {seen}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
