"""A contact sheet of a video with the landmarks that were tracked in it."""

from __future__ import annotations

import cv2
import numpy as np

from hwp_bench.base.drawing import labelled, sheet
from hwp_bench.importers.shared.hand_tracks import HandTracks
from hwp_bench.importers.shared.landmarks import LANDMARK_EDGES
from hwp_bench.importers.video.decode import read_frames
from hwp_bench.importers.video.video_settings import FrameRange
from hwp_bench.tracking.track_video import TrackedVideo

#: Colours of a right and a left hand.
COLOURS = {"right": (255, 160, 0), "left": (60, 200, 255)}
#: Frames in a row of the sheet.
_COLUMNS = 4
_SHIFT = 4


def landmark_sheet(tracked: TrackedVideo, *, count: int = 16, edge: int = 320) -> np.ndarray:
    """Draw frames that are evenly spaced over a video.

    Args:
        tracked: the video and its hands.
        count: number of frames.
        edge: longer side of each frame, px.

    Returns:
        (H, W, 3) uint8.
    """
    frames = tracked.hands.score.shape[1]
    stride = -(-frames // count)
    left, top, right, bottom = _window(tracked.hands)
    tiles: list[np.ndarray] = []
    for index, frame in read_frames(tracked.video, FrameRange(stride=stride)):
        if index < frames and len(tiles) < count:
            part = np.ascontiguousarray(frame[top:bottom, left:right])
            scale = edge / max(part.shape[:2])
            part = cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            drawn = draw_landmarks(part, tracked.hands, index, (left, top), scale)
            tiles.append(labelled(drawn, str(index)))
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


def draw_landmarks(
    image: np.ndarray, hands: HandTracks, frame: int, corner: tuple[int, int], scale: float
) -> np.ndarray:
    """Draw the hands of a frame.

    Args:
        image: (H, W, 3) uint8, a part of the frame; it is drawn on.
        hands: of the video.
        frame: its number.
        corner: the part's upper left corner in the frame, px.
        scale: of the image, relative to the frame.

    Returns:
        `image`.
    """
    for hand in range(len(hands.score)):
        if not hands.seen(hand)[frame]:
            continue
        colour = COLOURS[hands.side(hand)]
        points = (hands.image[hand, frame, :, :2] - corner) * scale - 0.5
        places = [tuple(int(v) for v in point) for point in np.round(points * 2**_SHIFT)]
        for start, end in LANDMARK_EDGES:
            cv2.line(image, places[start], places[end], colour, 1, cv2.LINE_AA, _SHIFT)
        for place in places:
            cv2.circle(image, place, 2 << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)
    return image
