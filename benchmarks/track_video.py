"""Hand tracking: distance from MediaPipe's own landmarks, speed, and the runtimes of the networks.

Run from the repository: `python -m benchmarks.track_video VIDEO [--landmarks NPZ]`, where NPZ is
the file that `tools/track_mediapipe.py` made of the video; or `python -m benchmarks.track_video
--runtimes`, which times each network in LiteRT and in OpenCV's DNN module. With `--mirrored` each
frame of the video is put next to its mirror image, so that there are two hands of known sides. All
need the networks (`hwp-bench data track --fetch`).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from hwp_bench.importers.shared.landmarks import HandTracks, read_landmarks
from hwp_bench.importers.video.decode import FrameRange, probe, read_frames
from hwp_bench.tracking import TrackerSettings, track_video
from hwp_bench.tracking.networks import LiteRtNetworks, load_models
from hwp_bench.tracking.track_video import track_frames

#: Calls of a network that are timed.
CALLS = 20


def agreement(hands: HandTracks, landmarks: Path) -> dict[str, float]:
    """Distances in px and mm from another tracker's landmarks, and frames that one lacks."""
    other = read_landmarks(landmarks, min_score=0.0)
    seen = hands.seen(0)
    both = seen & other.detected
    pixels = np.linalg.norm(hands.image[0, both, :, :2] - other.image[both], axis=2)
    metres = np.linalg.norm(hands.world[0, both] - other.world[both], axis=2)
    frames = pixels.mean(axis=1)
    return {
        "frames": float(len(seen)),
        "only here": float((seen & ~other.detected).sum()),
        "only there": float((other.detected & ~seen).sum()),
        "median px": float(np.median(pixels)),
        "95th percentile px": float(np.percentile(pixels, 95)),
        "99th percentile px": float(np.percentile(pixels, 99)),
        "frames above 1 px": float((frames > 1).sum()),
        "frames above 3 px": float((frames > 3).sum()),
        "median mm": float(np.median(metres) * 1000),
    }


def mirrored(video: Path) -> dict[str, float]:
    """Hands and sides that are found in a video of one hand next to its mirror image.

    The right half is the video, so that its hands are of the video's side and those of the left
    half of the other. Two hands must have landmarks that mirror each other.
    """

    def frames() -> Iterator[np.ndarray]:
        for _, frame in read_frames(probe(video), FrameRange()):
            half = cv2.resize(frame, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            yield np.concatenate([half[:, ::-1], half], axis=1)

    info = probe(video)
    width = 2 * (info.width // 2)
    networks = LiteRtNetworks(load_models())
    collected = track_frames(frames(), networks, TrackerSettings())
    hands = collected.hands((width, info.height // 2), 2)
    if hands is None or len(hands.score) != 2:
        return {"hands": 0.0 if hands is None else 1.0}
    x = hands.image[:, :, :, 0].mean(axis=2)
    both = hands.seen(0) & hands.seen(1)
    wrong = sum(
        int(
            (hands.seen(hand) & ((x[hand] > width / 2) != (x[hand][both].mean() > width / 2))).sum()
        )
        for hand in range(2)
    )
    flipped = hands.image[1, both, :, :2] * [-1, 1] + [width, 0]
    apart = np.linalg.norm(hands.image[0, both, :, :2] - flipped, axis=2)
    return {
        "hands": 2.0,
        "frames": float(collected.frames),
        "frames with both": float(both.sum()),
        "frames in the other half": float(wrong),
        "tracks": float(sum(len(np.unique(hands.track[i][hands.seen(i)])) for i in range(2))),
        "right, half of the video": hands.votes(int(x[0][both].mean() < width / 2))["right"],
        "right, mirrored half": hands.votes(int(x[0][both].mean() > width / 2))["right"],
        "median px apart": float(np.median(apart)),
    }


def runtimes() -> dict[str, float]:
    """Milliseconds of processor time of one call of each network, one thread."""
    cv2.setNumThreads(1)
    models, rng = load_models(), np.random.default_rng(0)
    ours = LiteRtNetworks(models)
    found = {}
    for name, content, edge, call in (
        ("palm", models.palm, 192, ours.palms),
        ("hand", models.hand, 224, ours.hand),
    ):
        image = rng.integers(0, 256, (edge, edge, 3), dtype=np.uint8)
        net = cv2.dnn.readNetFromTFLite(np.frombuffer(content, np.uint8))
        net.setInput(cv2.dnn.blobFromImage(image, 1 / 255))
        found[f"{name}, LiteRT"] = _milliseconds(partial(call, image))
        found[f"{name}, OpenCV"] = _milliseconds(net.forward)
    return found


def _milliseconds(call: Callable[[], object]) -> float:
    """Mean processor time of a call, after one that does not count."""
    call()
    began = time.process_time()
    for _ in range(CALLS):
        call()
    return (time.process_time() - began) / CALLS * 1000


def _show(values: Mapping[str, float]) -> None:
    for name, value in values.items():
        print(f"{name:26s} {value:10.3f}")


def main() -> int:
    """Run the benchmark; returns the exit status."""
    parser = argparse.ArgumentParser(description="Distance from MediaPipe, and speed.")
    parser.add_argument("video", type=Path, nargs="?")
    parser.add_argument("--landmarks", type=Path, help="made by tools/track_mediapipe.py")
    parser.add_argument("--mirrored", action="store_true", help="next to its mirror image")
    parser.add_argument("--runtimes", action="store_true", help="time the networks alone")
    args = parser.parse_args()
    if args.runtimes:
        _show(runtimes())
    if args.video is not None and args.mirrored:
        _show(mirrored(args.video))
    elif args.video is not None:
        began = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            tracked = track_video(args.video, Path(folder) / "hands.npz")
        spent = time.process_time() - began
        frames = tracked.hands.score.shape[1]
        _show({"seconds": tracked.seconds, "ms of processor/frame": spent / frames * 1000})
        if args.landmarks is not None:
            _show(agreement(tracked.hands, args.landmarks))
    return 0


if __name__ == "__main__":
    sys.exit(main())
