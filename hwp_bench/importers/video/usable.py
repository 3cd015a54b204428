"""Whether a tracked video can become an avatar: checked after tracking, before minutes of import.

The checks count frames: the size of the hand, whether it is cut off, how far it moves, its
exposure, its colour, and whether something is drawn over it. A fault in a tenth of the frames
that show the hand is reported, one in most of them leaves nothing that an avatar could be made of.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.colors import LUMA
from hwp_bench.base.console import notice
from hwp_bench.base.drawing import labelled, sheet
from hwp_bench.base.errors import BadInput
from hwp_bench.base.images import pixel_digest, write_image
from hwp_bench.hands.raster import draw_dots
from hwp_bench.hands.skeleton import LANDMARK_EDGES, SIDES, draw_bones
from hwp_bench.importers.shared.frames import cells
from hwp_bench.importers.shared.landmarks import PALM, Landmarks
from hwp_bench.importers.video.solve import contradiction
from hwp_bench.importers.video.source import VideoImport, VideoSource

#: Smallest hand, px of the video: the larger side of its landmarks' box in a typical frame.
SMALLEST = 60.0
# Share of the frames with a hand from which a fault is reported, and from which it is too much.
_SOME, _MOST = 0.1, 0.5
# A hand is cut off if so many of its 20 landmarks without the wrist lie outside of the frame.
_OUTSIDE = 3
# Most that the palm may move from frame to frame, in widths of a palm that faces the camera.
_FAST = 1.0
# Luma of pixels without structure, and the share of the hand that may have it.
_BRIGHT, _BRIGHT_SHARE = 245.0, 0.3
_DARK, _DARK_SHARE = 20.0, 0.7
# Least Cr of YCrCb in the fingers: less is grey, green or blue.
_SKIN = 130.0
# Difference of a bone's colours from those next to it, in Lab of 8 bits, that is drawn and no
# finger's shading; and how far from it, as a share of the hand's size.
_DRAWN, _SHIFT = 30.0, 0.025
# Places along a bone.
_ALONG = np.linspace(0.2, 0.8, 7)[:, None, None]
_BONES = np.array(LANDMARK_EDGES)
# Frames whose pixels are looked at.
_LOOKED_AT = 60
# Frames on the sheet, and in a row of it.
_COUNT, _COLUMNS = 12, 4


@dataclass(frozen=True)
class Fault:
    """A reason against a video."""

    #: With numbers, of a hand.
    said: str
    #: How to film it better.
    remedy: str
    #: Whether nothing useful can come of it.
    fatal: bool


@dataclass(frozen=True, eq=False)
class Quality:
    """Measurements of a hand in frames; (F,) each, NaN where it is not detected or looked at."""

    #: Larger side of the landmarks' box, px of the video.
    size: np.ndarray
    #: Landmarks outside of the frame, without the wrist.
    outside: np.ndarray
    #: Motion of the palm to the next frame of the video, in widths of the palm.
    moved: np.ndarray
    #: Share of the hand that is white, and that is black.
    bright: np.ndarray
    dark: np.ndarray
    #: Median Cr of YCrCb next to the bones.
    redness: np.ndarray
    #: Median difference of the bones' colours from those next to them, Lab.
    drawn: np.ndarray

    def faults(self, frame: int) -> list[str]:
        """Name what is wrong in a frame, in a word or two."""
        names = {
            "cut off": self.outside[frame] >= _OUTSIDE,
            "too fast": self.moved[frame] > _FAST,
            "overexposed": self.bright[frame] > _BRIGHT_SHARE,
            "underexposed": self.dark[frame] > _DARK_SHARE,
            "drawn over": self.drawn[frame] > _DRAWN,
        }
        return [name for name, here in names.items() if here]


def measure(source: VideoSource, landmarks: Landmarks) -> Quality:
    """Measure the frames of one hand."""
    points, seen, info = landmarks.image, landmarks.detected, source.video
    size = np.ptp(points, axis=1).max(axis=1)
    beyond = (points[:, 1:] < 0) | (points[:, 1:] > (info.width, info.height))
    outside = np.count_nonzero(np.any(beyond, axis=-1), axis=1)
    palm = points[:, list(PALM)].mean(axis=1)
    # Seen edge on, a palm is narrow.
    width = np.percentile(np.linalg.norm(points[seen, 5] - points[seen, 17], axis=-1), 90)
    steps = np.linalg.norm(np.diff(palm, axis=0), axis=-1) / np.diff(source.indices)
    moved = np.append(np.where(seen[1:] & seen[:-1], steps / max(float(width), 1e-6), 0.0), 0.0)
    looks = np.full((len(seen), 4), np.nan)
    edge = source.images.working.shape[1]
    places = source.windows.place(points, edge)
    corners = np.array([[0.0, 0.0], [info.width, info.height]])
    shown = np.flatnonzero(seen)
    for frame in shown[evenly(len(shown), _LOOKED_AT)].tolist():
        low, high = source.windows.place(corners, edge, frame).round().clip(0, edge).astype(int)
        # The window is black outside of the frame.
        part = source.images.working[frame, low[1] : high[1], low[0] : high[0]]
        if min(part.shape[:2]) > 0:
            looks[frame] = _look(part, places[frame] - low)
    unseen = np.where(seen, 0.0, np.nan)
    return Quality(size + unseen, outside + unseen, moved + unseen, *looks.T)


def _look(image: np.ndarray, points: np.ndarray) -> tuple[float, float, float, float]:
    """Shares of white and of black, redness and drawing of a hand at (21, 2) px of an image."""
    hand = np.zeros(image.shape[:2], np.uint8)
    cv2.fillConvexPoly(hand, cv2.convexHull(points.astype(np.float32)).astype(np.int32), 1)
    first, last = points[_BONES[:, 0]], points[_BONES[:, 1]]
    along = (first * (1.0 - _ALONG) + last * _ALONG).reshape(-1, 2)
    way = (last - first)[:, ::-1] * (-1.0, 1.0)
    way = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-6)
    shift = _SHIFT * float(np.ptp(points, axis=0).max()) * np.tile(way, (len(_ALONG), 1))
    rows, columns, inside = map(
        np.array,
        zip(*(cells(along + by, image.shape) for by in (0.0, shift, -shift)), strict=True),
    )
    inside = np.asarray(inside.all(axis=0))
    if not inside.any() or not hand.any():
        return (np.nan,) * 4
    colors = image[rows[:, inside], columns[:, inside]]
    lab = cv2.cvtColor(colors, cv2.COLOR_RGB2LAB).astype(np.float64)
    apart = np.linalg.norm(lab[0] - 0.5 * (lab[1] + lab[2]), axis=-1)
    redness = np.median(cv2.cvtColor(colors[1:], cv2.COLOR_RGB2YCrCb)[..., 1])
    luma = image[hand > 0] @ LUMA
    bright, dark = float((luma >= _BRIGHT).mean()), float((luma <= _DARK).mean())
    # White and black have no colour.
    known = bright <= _BRIGHT_SHARE and dark <= _DARK_SHARE
    return bright, dark, float(redness) if known else np.nan, float(np.median(apart))


def find_faults(
    source: VideoSource, side: str, quality: Quality, options: VideoImport
) -> list[Fault]:
    """Say what is wrong with one hand of a video; nothing of a sound one."""
    found: list[Fault] = []
    hand, seen = f"the {side} hand", source.hands[side].detected

    def often(values: np.ndarray, bad: np.ndarray, said: str, remedy: str) -> None:
        count, total = int(bad.sum()), int(np.isfinite(values).sum())
        if count > _SOME * total:
            said = f"{hand} {said} in {count} of {total} frames"
            found.append(Fault(said, remedy, count > _MOST * total))

    whole = "keep all of the hand in the picture"
    if seen.sum() < _MOST * len(seen):
        said = f"{hand} is seen in {seen.sum()} of {len(seen)} frames"
        found.append(Fault(said, whole, fatal=False))
    size = float(np.median(quality.size[seen]))
    if size < SMALLEST:
        said = f"{hand} is {size:.0f} px large in a typical frame, {SMALLEST:.0f} are needed"
        found.append(Fault(said, "film it from nearer", fatal=True))
    often(quality.outside, quality.outside >= _OUTSIDE, "is cut off", whole)
    fast = "moves more than its width to the next frame"
    often(quality.moved, quality.moved > _FAST, fast, "move the hand slowly")
    often(quality.bright, quality.bright > _BRIGHT_SHARE, "is overexposed", "film with less light")
    often(quality.dark, quality.dark > _DARK_SHARE, "is underexposed", "film with more light")
    over = "has lines drawn over it"
    often(quality.drawn, quality.drawn > _DRAWN, over, "give the video without the drawing")
    redness = quality.redness[np.isfinite(quality.redness)]
    if len(redness) and np.median(redness) < _SKIN:
        said = f"{hand} has no colour of skin, as a robot, a glove or a picture without colours"
        found.append(Fault(said, "film a bare human hand", fatal=False))
    votes = None if source.tracked is None else source.tracked.votes(side)
    stated = options.side in SIDES
    against = contradiction(side, source.scores[side], votes, stated=stated)
    if against is not None:
        clear = source.scores[side].is_clear and (votes is None or votes[side] < 0.5)
        remedy = "film without mirroring, or name the other hand with --side"
        found.append(Fault(against, remedy, stated and clear))
    return found


def say_faults(source: VideoSource, out: str | os.PathLike[str], options: VideoImport) -> None:
    """Warn of what is wrong with a video, with a sheet of its frames next to `out`.

    Raises:
        BadInput: by `options.strict`, nothing useful can come of it.
    """
    qualities = {side: measure(source, hand) for side, hand in source.hands.items()}
    faults = [
        fault
        for side, quality in qualities.items()
        for fault in find_faults(source, side, quality, options)
    ]
    if not faults:
        return
    drawn = _thumbnails(source, qualities)
    # The folder `.` has a name only in full. By its content: a file with this name is the same
    # sheet, so that none of a person is replaced.
    whole = Path(out).absolute()
    place = whole.with_name(f"{whole.name}_tracked_{pixel_digest(drawn)[:8]}.jpg")
    if not place.exists():
        write_image(place, drawn)
    said = "; ".join(dict.fromkeys(fault.said for fault in faults))
    better = ", ".join(dict.fromkeys(fault.remedy for fault in faults))
    shown = f"{place} shows what was tracked"
    if options.strict and any(fault.fatal for fault in faults):
        raise BadInput(
            f"no useful avatar can come of this video: {said}",
            where=source.video.path,
            remedy=f"{better[0].upper()}{better[1:]}; {shown}. `hwp-bench data import video` "
            "imports it all the same.",
        )
    notice(f"warning: {source.video.path}: {said}. To do better: {better}. {shown}.")


def _thumbnails(source: VideoSource, qualities: dict[str, Quality]) -> np.ndarray:
    """Frames with the tracked hands and what is wrong with them, (H, W, 3) uint8."""
    tiles = []
    for frame in evenly(len(source.indices), _COUNT).tolist():
        tile, said = source.images.frames[frame].copy(), f"frame {source.indices[frame]}"
        for side, landmarks in source.hands.items():
            if not landmarks.detected[frame]:
                said += ": not seen"
                continue
            points = source.windows.place(landmarks.image[frame], frame=frame)
            draw_bones(tile, points, (255, 160, 0))
            draw_dots(tile, points, (255, 255, 255), 1.5)
            quality = qualities[side]
            said += ": " + ", ".join([f"{quality.size[frame]:.0f} px", *quality.faults(frame)])
        tiles.append(labelled(tile, said))
    return sheet(tiles, _COLUMNS)
