"""From a video to the landmarks of its hands, and a sheet that shows them."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hwp_bench.base.console import progress
from hwp_bench.base.drawing import labelled, sheet
from hwp_bench.base.errors import HwpError, UsageError
from hwp_bench.hands.raster import draw_dots
from hwp_bench.hands.skeleton import draw_bones
from hwp_bench.importers.shared.landmarks import HandTracks, write_hand_tracks
from hwp_bench.importers.video.decode import (
    FrameRange,
    Reading,
    VideoInfo,
    probe,
    read_frames,
    warn_of_damage,
)
from hwp_bench.tracking.networks import LiteRtNetworks, load_models
from hwp_bench.tracking.tracker import Collected, HandTracker, TrackerSettings


class NoHandSeen(HwpError):
    """A tracker found a hand in none of the frames."""


@dataclass(frozen=True, eq=False)
class TrackedVideo:
    """The hands of a video."""

    #: The file.
    video: VideoInfo
    #: In every frame.
    hands: HandTracks
    #: Of tracking.
    seconds: float
    #: What came of reading the video.
    reading: Reading

    def facts(self) -> dict[str, Any]:
        """Return the numbers that describe the result, for JSON."""
        frames = self.hands.score.shape[1]
        return {
            "video": os.fspath(self.video.path),
            "frames": frames,
            "codec": self.video.codec,
            "colours": self.video.colours,
            "reading": self.reading.facts(),
            "frames_per_second": frames / max(self.seconds, 1e-9),
            "hands": [self._hand(hand) for hand in range(len(self.hands.score))],
        }

    def _hand(self, hand: int) -> dict[str, Any]:
        seen = self.hands.seen(hand)
        votes = self.hands.votes(hand)
        return {
            "side": self.hands.side(hand),
            "frames_seen": int(seen.sum()),
            "tracks": len(np.unique(self.hands.track[hand][seen])),
            "mean_score": float(self.hands.score[hand][seen].mean()),
            "right": votes["right"],
            "left": votes["left"],
        }


def track_video(
    video: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    settings: TrackerSettings | None = None,
    model: Path | None = None,
    overwrite: bool = False,
    networks: LiteRtNetworks | None = None,
) -> TrackedVideo:
    """Track the hands of a video and write their landmarks.

    Args:
        video: any file that `hwp_bench.importers.video.decode` reads, not mirrored.
        out: `.npz` to write; the importer reads it.
        model: file or folder of the networks; None takes the cache, or downloads them once.
        overwrite: replace an existing file.
        networks: to run in place of the model.

    Raises:
        BadInput: video or model cannot be used.
        NoHandSeen: no frame shows a hand.
        HwpError: the networks are not available.
        MissingDependency: `ai-edge-litert` is not installed.
        UsageError: `out` exists, or is not an `.npz`.
    """
    out = Path(out)
    if out.suffix != ".npz":
        raise UsageError("must end in .npz", where=out, field="-o")
    if out.exists() and not overwrite:
        raise UsageError("exists already", where=out, remedy="Choose another name, or --force.")
    settings = settings or TrackerSettings()
    info = probe(video)
    if networks is None:
        networks = LiteRtNetworks(load_models(model))
    began = time.perf_counter()
    endings: list[Reading] = []
    with progress("tracking hands", max(info.stated_frames, 1)) as update:
        frames = (frame for _, frame in read_frames(info, FrameRange(), endings.append))
        collected = track_frames(frames, networks, settings, update)
    warn_of_damage(info, endings[0])
    hands = collected.hands((info.width, info.height), settings.hands)
    if hands is None:
        raise NoHandSeen(
            f"none of {collected.frames} frames shows a hand",
            where=info.path,
            remedy="The whole hand must be visible. Lower --min-confidence to accept less.",
        )
    tracked = TrackedVideo(info, hands, time.perf_counter() - began, endings[0])
    write_hand_tracks(out, hands)
    return tracked


def track_frames(
    frames: Iterable[np.ndarray],
    networks: LiteRtNetworks,
    settings: TrackerSettings,
    update: Any = None,
) -> Collected:
    """Track hands through frames, (H, W, 3) uint8 RGB; one frame is in memory at a time."""
    tracker, collected = HandTracker(networks, settings), Collected()
    for frame in frames:
        collected.add(tracker.step(frame))
        if update is not None:
            update(collected.frames)
    return collected


# --- A contact sheet of a video with the landmarks that were tracked in it

#: Colours of a right and a left hand.
COLOURS = {"right": (255, 160, 0), "left": (60, 200, 255)}
# Frames on the sheet and in a row of it, and the longer side of each, px.
_COUNT, _COLUMNS, _EDGE = 16, 4, 320


def landmark_sheet(tracked: TrackedVideo) -> np.ndarray:
    """Draw frames, evenly spaced over a video, with their hands: (H, W, 3) uint8."""
    frames = tracked.hands.score.shape[1]
    stride = -(-frames // _COUNT)
    left, top, right, bottom = _window(tracked.hands)
    tiles: list[np.ndarray] = []
    for index, frame in read_frames(tracked.video, FrameRange(stride=stride)):
        if index < frames and len(tiles) < _COUNT:
            part = np.ascontiguousarray(frame[top:bottom, left:right])
            scale = _EDGE / max(part.shape[:2])
            part = cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            _draw_landmarks(part, tracked.hands, index, (left, top), scale)
            tiles.append(labelled(part, str(index)))
    return sheet(tiles, _COLUMNS)


def _window(hands: HandTracks) -> tuple[int, int, int, int]:
    """The part of the frame in which hands are seen: left, top, right, bottom, px."""
    points = hands.image[hands.score > 0][:, :, :2].reshape(-1, 2)
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.15 * float((high - low).max())
    size = np.array(hands.size)
    # At least 16 px of the frame, also where all landmarks lie outside of it.
    low = np.clip(np.floor(low - margin), 0, np.maximum(size - 16, 0)).astype(int)
    high = np.clip(np.ceil(high + margin), np.minimum(low + 16, size), size).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _draw_landmarks(
    image: np.ndarray, hands: HandTracks, frame: int, corner: tuple[int, int], scale: float
) -> None:
    """Draw the hands of a frame on a part of it, (H, W, 3) uint8.

    `corner` is the part's upper left corner in the frame, px; `scale` the image's, relative to it.
    """
    for hand in range(len(hands.score)):
        if hands.seen(hand)[frame]:
            points = (hands.image[hand, frame, :, :2] - corner) * scale
            draw_bones(image, points, COLOURS[hands.side(hand)])
            draw_dots(image, points, COLOURS[hands.side(hand)], 2.0)
