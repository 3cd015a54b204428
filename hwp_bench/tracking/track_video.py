"""From a video to the landmarks of its hands, followed from frame to frame, and a sheet of them.

A hand that was seen in the last frame is looked for around the place where it was; palms are
searched only while fewer hands are followed than may be there. Source: MediaPipe's graph
`hand_landmark_tracking_cpu`. Two things differ: next to a hand that is followed without a gap, a
second one is searched in every fifth frame only; and two tracks that end on one hand are made one,
as the newer Tasks of MediaPipe do.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hwp_bench.base.console import progress
from hwp_bench.base.drawing import labelled, sheet
from hwp_bench.base.errors import HwpError, UsageError
from hwp_bench.base.images import write_image
from hwp_bench.hands.raster import draw_dots
from hwp_bench.hands.skeleton import draw_bones
from hwp_bench.importers.shared.frames import ahead
from hwp_bench.importers.shared.landmarks import HandTracks, write_hand_tracks
from hwp_bench.importers.video.decode import (
    FrameRange,
    Reading,
    VideoInfo,
    probe,
    read_frames,
    warn_of_damage,
)
from hwp_bench.tracking.networks import (
    HAND_EDGE,
    LiteRtNetworks,
    Region,
    SeenHand,
    cut_region,
    decode,
    load_models,
    overlap,
    palm_input,
    place_in_image,
    suppress,
)

#: Two regions with more overlap than this show one hand.
_SAME_REGION = 0.5
#: Two hands are one if their landmarks differ by less than this share of their size, on average.
_SAME_HAND = 0.2
#: While a hand is followed, palms are searched in one of so many frames, and in all of so many
#: after a hand was lost.
_PALMS_EVERY, _PALMS_AFTER = 5, 15


@dataclass(frozen=True)
class TrackerSettings:
    """Settings of the tracker; the defaults are MediaPipe's."""

    #: Most hands in a frame, 1 or 2.
    hands: int = 2
    #: Palms below this score are left out.
    min_palm_score: float = 0.5
    #: Hands below this presence are lost.
    min_presence: float = 0.5

    def __post_init__(self) -> None:
        if self.hands not in (1, 2):
            raise UsageError(f"is {self.hands}", field="hands", remedy="Use 1 or 2.")
        for name in ("min_palm_score", "min_presence"):
            value = getattr(self, name)
            if not 0 < value < 1:
                raise UsageError(f"is {value}", field=name, remedy="Use a number between 0 and 1.")


@dataclass(frozen=True, eq=False)
class TrackedHand:
    """A hand in a frame."""

    #: Number of the track, a stretch of frames without a gap; counts from 0.
    track: int
    #: What was seen.
    hand: SeenHand


class HandTracker:
    """Follows hands through consecutive frames."""

    def __init__(self, networks: LiteRtNetworks, settings: TrackerSettings | None = None) -> None:
        self._networks = networks
        self._settings = settings or TrackerSettings()
        self._followed: list[TrackedHand] = []
        self._tracks = 0
        # The number of the frame, and of the last one in which a hand was lost.
        self._frame, self._lost = 0, -_PALMS_AFTER

    def step(self, frame: np.ndarray) -> list[TrackedHand]:
        """Find the hands of the next frame, (H, W, 3) uint8 RGB; known ones keep their tracks."""
        seen: list[tuple[TrackedHand, float]] = []
        for region, before in self._regions(frame):
            image = cut_region(frame, region, HAND_EDGE, outside_black=False)
            reading = self._networks.hand(image)
            values = (reading.presence, reading.right)
            if not np.isfinite(values).all() or reading.presence < self._settings.min_presence:
                continue
            hand = reading.place_in(region)
            if not (np.isfinite(hand.image).all() and np.isfinite(hand.world).all()):
                continue
            moved = np.inf if before is None else _distance(hand, before.hand)
            track = -1 if before is None else before.track
            seen.append((TrackedHand(track, hand), moved))
        known = len(self._followed)
        self._followed = []
        for one in _without_doubles(seen)[: self._settings.hands]:
            number = one.track
            if number < 0:
                # A new track.
                number, self._tracks = self._tracks, self._tracks + 1
            self._followed.append(TrackedHand(number, one.hand))
        if len(self._followed) < known:
            self._lost = self._frame
        self._frame += 1
        return list(self._followed)

    def _regions(self, frame: np.ndarray) -> list[tuple[Region, TrackedHand | None]]:
        """Regions to look at, with the hand that each of them follows."""
        followed: list[tuple[Region, TrackedHand | None]] = []
        for hand in self._followed:
            region = hand.hand.next_region()
            if _is_sound(region, frame):
                followed = [one for one in followed if overlap(one[0], region) <= _SAME_REGION]
                followed.append((region, hand))
        due = self._frame % _PALMS_EVERY == 0 or self._frame - self._lost <= _PALMS_AFTER
        searched = len(followed) < self._settings.hands and (due or not followed)
        for region in self._new_regions(frame) if searched else ():
            if all(overlap(region, other) <= _SAME_REGION for other, _ in followed):
                followed.append((region, None))
        return followed

    def _new_regions(self, frame: np.ndarray) -> list[Region]:
        """Regions of the palms in a frame, best first."""
        height, width = frame.shape[:2]
        values, logits = self._networks.palms(palm_input(frame))
        palms = suppress(decode(values, logits, self._settings.min_palm_score))
        regions = [place_in_image(palm, width, height).hand_region() for palm in palms]
        return [region for region in regions[: self._settings.hands] if _is_sound(region, frame)]


def _without_doubles(seen: list[tuple[TrackedHand, float]]) -> list[TrackedHand]:
    """Leave out hands that repeat another one; the one that moved least is kept."""
    kept: list[TrackedHand] = []
    for hand, _ in sorted(seen, key=lambda pair: pair[1]):
        size = hand.hand.size()
        if all(
            _distance(hand.hand, other.hand) > _SAME_HAND * max(size, other.hand.size())
            for other in kept
        ):
            kept.append(hand)
    return kept


def _distance(one: SeenHand, other: SeenHand) -> float:
    """Mean distance of the landmarks of two hands, px."""
    return float(np.linalg.norm(one.image[:, :2] - other.image[:, :2], axis=1).mean())


def _is_sound(region: Region, frame: np.ndarray) -> bool:
    """Whether a region can be looked at: of a size, and not far outside of the frame."""
    height, width = frame.shape[:2]
    longest = max(width, height)
    return (
        2 <= region.width <= 8 * longest
        and 2 <= region.height <= 8 * longest
        and -longest <= region.x <= width + longest
        and -longest <= region.y <= height + longest
    )


# --- From tracks to hands: which stretches of frames belong to one hand, and which side it is
#
# A track ends where its hand is lost, and the next one has another number. The network says in
# each frame whether it sees a right or a left hand. It errs in single frames, so that all frames
# of a track vote together.

#: A second hand is seen in at least this share of the frames that show the first; what is less is
#: the first hand with a wrong side, or a mistake.
_SECOND_HAND = 0.1
#: Strongest vote of one frame, in units of probability away from 0.5.
_VOTE = 0.5


@dataclass(frozen=True, eq=False)
class _Track:
    """One track: its number, its frames, the rows of its hands, and what they vote for."""

    number: int
    frames: np.ndarray
    rows: np.ndarray
    votes: float


class Collected:
    """Everything that the tracker saw, in the order of the frames; 600 bytes for each hand."""

    def __init__(self) -> None:
        # Frame, track, landmarks in the image and in space, presence, right.
        self._rows: list[tuple[int, int, np.ndarray, np.ndarray, float, float]] = []
        self.frames = 0

    def add(self, hands: Sequence[TrackedHand]) -> None:
        """Take the hands of the next frame."""
        for one in hands:
            image, world = one.hand.image.astype(np.float32), one.hand.world.astype(np.float32)
            scores = (one.hand.presence, one.hand.right)
            self._rows.append((self.frames, one.track, image, world, *scores))
        self.frames += 1

    def hands(self, size: tuple[int, int], most: int) -> HandTracks | None:
        """Join the tracks to 1 or 2 (`most`) hands; None where nothing was seen. `size`: px."""
        if not self._rows:
            return None
        frame, track, image, world, score, right = map(np.array, zip(*self._rows, strict=True))
        score, right = (np.clip(part.astype(np.float32), 0, 1) for part in (score, right))
        owner = _owners(frame, track, right, most)
        count = int(owner.max()) + 1
        shape = (count, self.frames)
        made = HandTracks(
            np.zeros((*shape, 21, 3), np.float32),
            np.zeros((*shape, 21, 3), np.float32),
            np.zeros(shape, np.float32),
            np.full(shape, 0.5, np.float32),
            np.full(shape, -1, np.int32),
            size,
        )
        kept = owner >= 0
        place = owner[kept], frame[kept]
        made.image[place], made.world[place] = image[kept], world[kept]
        made.score[place], made.right[place] = score[kept], right[kept]
        made.track[place] = track[kept]
        return made


def _owners(frame: np.ndarray, track: np.ndarray, right: np.ndarray, most: int) -> np.ndarray:
    """The hand of each row: 0 for the one that is seen most, 1 for the other, -1 for none."""
    tracks = []
    for number in np.unique(track):
        rows = np.flatnonzero(track == number)
        votes = float(np.clip(right[rows].astype(np.float64) - 0.5, -_VOTE, _VOTE).sum())
        tracks.append(_Track(int(number), frame[rows], rows, votes))
    sides = _by_side(tracks)
    lengths = [sum(len(one.frames) for one in side) for side in sides]
    first, second = sides if lengths[0] >= lengths[1] else sides[::-1]
    if most == 1 or min(lengths) < _SECOND_HAND * max(lengths):
        # Tracks of the second fill frames in which the first is not seen.
        taken = {frame for one in first for frame in one.frames.tolist()}
        spare = [one for one in second if taken.isdisjoint(one.frames.tolist())]
        first, second = [*first, *spare], []
    owner = np.full(len(frame), -1)
    for hand, side in enumerate((first, second)):
        for one in side:
            owner[one.rows] = hand
    return owner


def _by_side(tracks: list[_Track]) -> tuple[list[_Track], list[_Track]]:
    """Right and left tracks.

    Two tracks of one frame are different hands, so that the surer one has the first choice.
    """
    sides: tuple[list[_Track], list[_Track]] = ([], [])
    taken: tuple[set[int], set[int]] = (set(), set())
    for one in sorted(tracks, key=lambda track: -abs(track.votes)):
        frames = set(one.frames.tolist())
        wanted = 0 if one.votes >= 0 else 1
        for side in (wanted, 1 - wanted):
            if not frames & taken[side]:
                sides[side].append(one)
                taken[side].update(frames)
                break
    return sides


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
    unseen: Path | None = None,
) -> TrackedVideo:
    """Track the hands of a video and write their landmarks.

    Args:
        video: any file that `hwp_bench.importers.video.decode` reads, not mirrored.
        out: `.npz` to write; the importer reads it.
        model: file or folder of the networks; None takes the cache, or downloads them once.
        overwrite: replace an existing file.
        networks: to run in place of the model.
        unseen: image of some frames that is written where none shows a hand.

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
        raise UsageError("exists already", where=out, remedy="Choose another name, or --overwrite.")
    settings = settings or TrackerSettings()
    info = probe(video)
    if networks is None:
        networks = LiteRtNetworks(load_models(model))
    began = time.perf_counter()
    endings: list[Reading] = []
    with progress("tracking hands", max(info.stated_frames, 1)) as update:
        frames = (frame for _, frame in ahead(read_frames(info, FrameRange(), endings.append)))
        collected = track_frames(frames, networks, settings, update)
    warn_of_damage(info, endings[0])
    hands = collected.hands((info.width, info.height), settings.hands)
    if hands is None:
        shown = ""
        if unseen is not None:
            write_image(unseen, landmark_sheet(info, collected.frames, None))
            shown = f" ({unseen} has some of them)"
        raise NoHandSeen(
            f"none of {collected.frames} frames shows a hand{shown}",
            where=info.path,
            remedy="The whole hand must be visible. Lower --min-score to accept less.",
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


def landmark_sheet(video: VideoInfo, frames: int, hands: HandTracks | None) -> np.ndarray:
    """Draw some of a video's `frames`, evenly spaced, with their hands: (H, W, 3) uint8."""
    stride = -(-frames // _COUNT)
    left, top, right, bottom = 0, 0, video.width, video.height
    if hands is not None:
        left, top, right, bottom = _window(hands)
    tiles: list[np.ndarray] = []
    for index, frame in read_frames(video, FrameRange(stride=stride)):
        if index < frames and len(tiles) < _COUNT:
            part = np.ascontiguousarray(frame[top:bottom, left:right])
            scale = _EDGE / max(part.shape[:2])
            part = cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            if hands is not None:
                _draw_landmarks(part, hands, index, (left, top), scale)
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
