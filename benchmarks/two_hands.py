"""The import of two hands, measured on a real hand and its mirror image in one picture.

Run from the repository: `python -m benchmarks.two_hands FOLDER --video VIDEO --landmarks NPZ`. The
mirror image moves in front of the hand and leaves it again; the landmarks are those that a
tracker found in the clip itself, where it saw one hand, exchanged at three frames. So the landmarks
of both are known. Writes the clip, its capture and its sheet into FOLDER.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hwp_bench.importers.shared.landmarks import HandTracks, read_landmarks, write_hand_tracks
from hwp_bench.importers.video import ImportedClip, SolveSettings, VideoImport, import_video
from hwp_bench.importers.video.decode import FrameRange, probe, read_frames

#: Shift of the mirror image to the left when it is apart, and to the right when it is nearest, px.
APART, NEAR = 170.0, 150.0
#: Votes for a right hand that the tracker's network gives the hand and its mirror image.
VOTES = (0.96, 0.07)
#: Skin in the clip: least Cr of YCrCb, and the rectangle of hand and forearm (x, y, x, y).
_SKIN, _PLACE = 138, (560, 60, 960, 720)


@dataclass(frozen=True, eq=False)
class Composed:
    """A composed clip.

    Attributes:
        video: its file.
        landmarks: the file of a tracker that exchanges hands.
        true: (2, F, 21, 2) px, landmarks of the hand and of its mirror image.
        swaps: number of exchanges.
    """

    video: Path
    landmarks: Path
    true: np.ndarray
    swaps: int


def compose(video: Path, landmarks: Path, folder: Path, *, frames: int, stride: int) -> Composed:
    """Put the clip's hand and its mirror image into one picture.

    Args:
        video: the real clip, 1280x720, one hand.
        landmarks: of all of its frames.
        folder: where the clip goes.
        frames: number of frames.
        stride: distance between them in the clip.
    """
    with np.load(landmarks) as stored:
        image, world = (stored[name][: frames * stride : stride] for name in ("image", "world"))
    chosen = FrameRange(stop=frames * stride, stride=stride)
    pictures = [
        np.ascontiguousarray(rgb[:, :, ::-1]) for _, rgb in read_frames(probe(video), chosen)
    ]
    height, width = pictures[0].shape[:2]
    nearness = np.sin(np.linspace(0, np.pi, frames))
    shift = np.round(nearness * (APART + NEAR) - APART)
    mirrored_image, mirrored_world = image.copy(), world * (-1, 1, 1)
    mirrored_image[:, :, 0] = width - image[:, :, 0] + shift[:, None]
    both = np.stack([image, mirrored_image])
    score, right = np.ones((2, frames)), np.tile(np.array(VOTES)[:, None], (1, frames))
    target = folder / "composed.avi"
    writer = cv2.VideoWriter(
        str(target), cv2.VideoWriter.fourcc(*"MJPG"), 30.0 / stride, (width, height)
    )
    for frame, picture in enumerate(pictures):
        skin = _skin(picture)[:, ::-1]
        move = np.array([[1.0, 0.0, shift[frame]], [0.0, 1.0, 0.0]])
        front = cv2.warpAffine(np.ascontiguousarray(skin), move, (width, height))
        over = cv2.warpAffine(np.ascontiguousarray(picture[:, ::-1]), move, (width, height))
        writer.write(np.where(front[:, :, None] > 0, over, picture).astype(np.uint8))
    writer.release()
    rows = [both, np.stack([world, mirrored_world]), score, right, np.where(score > 0, 0, -1)]
    swaps = (frames // 4, frames // 2, 3 * frames // 4)
    for first in swaps:
        for array in rows:
            array[:, first:] = array[::-1, first:].copy()
    kinds = (np.float32, np.float32, np.float32, np.float32, np.int32)
    made = [array.astype(kind) for array, kind in zip(rows, kinds, strict=True)]
    tracks = HandTracks(made[0], made[1], made[2], made[3], made[4], (width, height))
    true = np.stack([image, mirrored_image])[..., :2]
    return Composed(target, write_hand_tracks(folder / "composed.npz", tracks), true, len(swaps))


def measure(composed: Composed, clip: ImportedClip) -> dict[str, object]:
    """Compare an import of a composed clip with the landmarks that are known."""
    found: dict[str, object] = {
        "swaps": composed.swaps,
        "swaps_repaired": clip.facts()["swaps_repaired"],
    }
    for side, true in zip(("right", "left"), composed.true, strict=True):
        read = read_landmarks(composed.landmarks, min_score=0.5, side=side)
        apart = np.abs(read.image - true)[read.detected].max()
        fitted = clip.hands[side].projected.landmarks
        error = np.linalg.norm(fitted - true, axis=-1).mean(axis=1)
        found[side] = {
            "frames_valid": int(clip.hands[side].parameters.valid.sum()),
            "association_px": float(apart),
            "joints_px": float(error.mean()),
        }
    found["overlap"] = float(clip.masks.overlap.mean())
    found["focal_px"] = clip.focal
    return found


def _skin(picture: np.ndarray) -> np.ndarray:
    """(H, W) uint8, 255 where hand and forearm are."""
    chroma = cv2.cvtColor(picture, cv2.COLOR_BGR2YCrCb)[:, :, 1]
    left, top, right, bottom = _PLACE
    mask = np.zeros(chroma.shape, dtype=np.uint8)
    mask[top:bottom, left:right] = np.where(chroma[top:bottom, left:right] > _SKIN, 255, 0)
    return np.asarray(cv2.medianBlur(mask, 7), dtype=np.uint8)


def main(arguments: list[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").split("\n")[0], formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--video", type=Path, required=True)
    parser.add_argument("--landmarks", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--stride", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="fewer steps of the fit")
    args = parser.parse_args(arguments)
    args.folder.mkdir(parents=True, exist_ok=True)
    composed = compose(
        args.video, args.landmarks, args.folder, frames=args.frames, stride=args.stride
    )
    fit = SolveSettings()
    if args.quick:
        fit = SolveSettings(
            start_steps=60,
            landmark_steps=90,
            contour_steps=20,
            contour_rounds=1,
            texture=False,
        )
    options = VideoImport(fit=fit, overwrite=True, sheet=args.folder / "sheet.png")
    clip = import_video(composed.video, composed.landmarks, args.folder / "capture", options)
    print(json.dumps(measure(composed, clip), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
