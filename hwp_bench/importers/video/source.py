"""The inputs of a video import: read from outside, checked, and the sides of the hands found."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hwp_bench.base.console import notice, progress
from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.capture.schema import MAX_FRAMES
from hwp_bench.importers.shared.association import read_association, tracked_sides, tracked_votes
from hwp_bench.importers.shared.landmarks import Landmarks, check_against_video, read_landmarks
from hwp_bench.importers.shared.windows import CropWindows, follow_hands
from hwp_bench.importers.video.decode import (
    ClipImages,
    Reading,
    VideoInfo,
    check_memory,
    probe,
    read_images,
    read_masks,
    warn_of_damage,
)
from hwp_bench.importers.video.fit_clip import Footage
from hwp_bench.importers.video.side_check import side_scores, warn_of_contradiction
from hwp_bench.importers.video.video_settings import VideoImport

#: Sides of two hands, in the order in which a capture has them.
BOTH = ("right", "left")


@dataclass(frozen=True, eq=False)
class VideoSource:
    """The inputs of an import.

    Attributes:
        video: the probed video.
        landmarks_path: the tracker's file.
        indices: (F,) frame numbers in the video.
        hands: landmarks of those frames by side, the hand that is detected most first.
        windows: where the hands are.
        images: the frames.
        own_masks: (F, S, S) uint8 or None.
        swaps: how often the tracker had exchanged two hands, over the whole video.
        doubles: number of frames in which it had put both on one hand.
        reading: what came of reading the video to its end; None where a part was read.
    """

    video: VideoInfo
    landmarks_path: Path
    indices: np.ndarray
    hands: Mapping[str, Landmarks]
    windows: CropWindows
    images: ClipImages
    own_masks: np.ndarray | None
    swaps: int = 0
    doubles: int = 0
    reading: Reading | None = None

    @property
    def landmarks(self) -> Landmarks:
        """Landmarks of the hand that is detected most."""
        return next(iter(self.hands.values()))

    @property
    def detected(self) -> np.ndarray:
        """(F,) bool, frames in which a hand is detected."""
        return np.any([hand.detected for hand in self.hands.values()], axis=0)


def read_source(
    video: str | os.PathLike[str], landmarks: str | os.PathLike[str], options: VideoImport
) -> VideoSource:
    """Read and check everything that the import needs from outside.

    Raises:
        BadInput: one of the files is unusable; file and field are named.
        UsageError: an option makes no sense for these files.
    """
    info = probe(video)
    every = _read_hands(landmarks, options)
    # Containers may state a wrong number of frames. A whole video is counted as it is decoded.
    # The end of a part is never read, so the header is trusted.
    part = options.frames.stop is not None
    count = len(next(iter(every.values())).score)
    total = info.stated_frames if part and info.stated_frames else count
    tracked = {
        side: check_against_video(hand, total, info.width, info.height, landmarks)
        for side, hand in every.items()
    }
    indices = options.frames.indices(total)
    if not 3 <= len(indices) <= MAX_FRAMES:
        raise UsageError(
            f"{len(indices)} of {total} frames are selected, a capture has 3 to {MAX_FRAMES}",
            field="--frames",
        )
    selected = {side: hand.select(indices) for side, hand in tracked.items()}
    seen = {side: hand for side, hand in selected.items() if hand.detected.any()}
    if not seen:
        raise UsageError("no hand is detected in the selected frames", field="--frames")
    for side in selected.keys() - seen.keys():
        notice(f"The {side} hand is in none of the selected frames and is left out.")
    footage = Footage(info.width, info.height, info.fps / options.frames.stride, options.focal)
    hands = _checked_sides(seen, landmarks, options, footage)
    windows = follow_hands(list(hands.values()), footage.fps, options.size)
    check_memory(windows)
    own = None if options.masks is None else read_masks(options.masks, info, indices, windows)
    endings: list[Reading] = []
    with progress("reading frames", len(indices)) as update:
        images = read_images(info, options.frames, windows, update, endings.append)
    reading = endings[0] if endings else None
    if reading is not None:
        warn_of_damage(info, reading)
    found = read_association(landmarks) if len(hands) == 2 else None
    repaired = (0, 0) if found is None else (found.swaps, found.doubles)
    return VideoSource(
        info, Path(landmarks), indices, hands, windows, images, own, *repaired, reading
    )


def _read_hands(path: str | os.PathLike[str], options: VideoImport) -> dict[str | None, Landmarks]:
    """Landmarks by side; the key is None where the file says nothing of it and nobody else."""
    sides: tuple[str | None, ...]
    if options.side in BOTH:
        sides = (options.side,)
    else:
        sides = tracked_sides(path) or (None,)
        if options.side == "both" and len(sides) < 2:
            raise BadInput(
                "has landmarks of one hand",
                where=path,
                field="--side",
                remedy="Track the video with `hwp-bench data track`, or import one hand.",
            )
    return {side: read_landmarks(path, min_score=options.min_score, side=side) for side in sides}


def _checked_sides(
    hands: Mapping[str | None, Landmarks],
    path: str | os.PathLike[str],
    options: VideoImport,
    footage: Footage,
) -> dict[str, Landmarks]:
    """Ask the pictures which hands they show, before minutes of work."""
    checked = {}
    for side, hand in hands.items():
        scores = side_scores(hand, options.hand_model, footage)
        if side is not None:
            votes = tracked_votes(path, side)
            warn_of_contradiction(side, scores, votes, stated=options.side in BOTH)
        checked[side or scores.better] = hand
    return checked
