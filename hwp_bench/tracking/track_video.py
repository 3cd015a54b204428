"""From a video to the landmarks of its hands."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.console import progress
from hwp_bench.base.errors import HwpError, UsageError
from hwp_bench.importers.shared.hand_tracks import HandTracks, write_hand_tracks
from hwp_bench.importers.video.decode import (
    Reading,
    VideoInfo,
    probe,
    read_frames,
    warn_of_damage,
)
from hwp_bench.importers.video.video_settings import FrameRange
from hwp_bench.tracking.assemble import Collected
from hwp_bench.tracking.model_files import load_models
from hwp_bench.tracking.networks import HandNetworks, LiteRtNetworks
from hwp_bench.tracking.tracker import HandTracker, TrackerSettings


class NoHandSeen(HwpError):
    """A tracker found a hand in none of the frames."""


@dataclass(frozen=True, eq=False)
class TrackedVideo:
    """The hands of a video.

    Attributes:
        video: the file.
        hands: in every frame.
        seconds: of tracking.
        reading: what came of reading the video.
    """

    video: VideoInfo
    hands: HandTracks
    seconds: float
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
    networks: HandNetworks | None = None,
) -> TrackedVideo:
    """Track the hands of a video and write their landmarks.

    Args:
        video: any file that `hwp_bench.importers.video.decode` reads, not mirrored.
        out: `.npz` to write (`hand_tracks` describes it); the importer reads it.
        settings: thresholds; the defaults where None.
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
    networks: HandNetworks,
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
