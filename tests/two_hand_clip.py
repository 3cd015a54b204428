"""Two hands that pass in front of each other, and a tracker that errs, exchanges and loses them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from synthetic_clip import HEIGHT, WALL, WIDTH, SyntheticClip, make_clip, write_video

from hwp_bench.importers.shared.landmarks import HandTracks, write_hand_tracks

#: Errors of the landmarks (standard deviations): px in the image, m in space.
IMAGE_NOISE, WORLD_NOISE = 1.0, 0.003


@dataclass(frozen=True)
class TwoHandClip:
    """Truth: the right hand is in front, the left one 6 cm behind it."""

    right: SyntheticClip
    left: SyntheticClip

    @property
    def hands(self) -> dict[str, SyntheticClip]:
        return {"right": self.right, "left": self.left}

    def picture(self, frame: int) -> np.ndarray:
        """(HEIGHT, WIDTH, 3) uint8."""
        noise = np.random.default_rng(frame).normal(0, 4, (HEIGHT, WIDTH, 3))
        picture = np.tile(np.array(WALL, float), (HEIGHT, WIDTH, 1))
        for hand in (self.left, self.right):
            hand.paint(picture, frame)
        return np.clip(picture + noise, 0, 255).astype(np.uint8)


def make_two_hands(frames: int, *, nearest: float = 0.035) -> TwoHandClip:
    """Hands that come together until their middles are `2 * nearest` m apart, and part again."""
    aside = 0.105 - (0.105 - nearest) * np.sin(np.linspace(0, np.pi, frames))
    away = np.stack([-aside, 0 * aside, 0 * aside], axis=1)
    behind = np.stack([aside, 0 * aside, 0 * aside + 0.06], axis=1)
    return TwoHandClip(
        make_clip(frames, side="right", shift=away), make_clip(frames, side="left", shift=behind)
    )


def write_two_hands(
    folder: Path, clip: TwoHandClip, swaps: tuple[int, ...], gap: range, lost: str = "left"
) -> tuple[Path, Path]:
    """Write the video, and the landmarks of a tracker.

    Args:
        folder: of both files.
        clip: the hands.
        swaps: frames from which on the tracker has exchanged the hands.
        gap: frames in which it does not see one of the hands.
        lost: that hand; the left one is behind.
    """
    random = np.random.default_rng(7)
    frames = len(clip.right.landmarks.score)
    image = np.zeros((2, frames, 21, 3))
    world = np.zeros((2, frames, 21, 3))
    for row, hand in enumerate(clip.hands.values()):
        true = hand.landmarks
        image[row, :, :, :2] = true.image + random.normal(0, IMAGE_NOISE, true.image.shape)
        world[row] = true.world + random.normal(0, WORLD_NOISE, true.world.shape)
    score, right = np.ones((2, frames)), np.stack([np.full(frames, 0.9), np.full(frames, 0.1)])
    # Votes err in single frames.
    right[:, :: max(frames // 4, 1)] = 0.5
    hand = list(clip.hands).index(lost)
    score[hand, list(gap)], right[hand, list(gap)] = 0.0, 0.5
    image[hand, list(gap)] = world[hand, list(gap)] = 0.0
    track = np.where(score > 0, 0, -1)
    for first in swaps:
        for array in (image, world, score, right, track):
            array[:, first:] = array[::-1, first:].copy()
    tracks = HandTracks(
        image.astype(np.float32),
        world.astype(np.float32),
        score.astype(np.float32),
        right.astype(np.float32),
        track.astype(np.int32),
        (WIDTH, HEIGHT),
    )
    video = write_video(folder / "hands.avi", [clip.picture(frame) for frame in range(frames)])
    return video, write_hand_tracks(folder / "hands.npz", tracks)
