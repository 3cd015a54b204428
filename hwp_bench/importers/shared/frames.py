"""Frames of a clip: the square window that follows its hands, and work in several threads."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from hwp_bench.hands.poses import interpolate
from hwp_bench.importers.shared.landmarks import Landmarks

#: Room around the outermost landmark, as a share of the window's half side; finger tips reach
#: about 10 % of the hand beyond their landmark, and a little background shows the silhouette.
MARGIN = 0.22
#: The window's centre is smoothed over this time (standard deviation, s): a window that
#: trembles with the landmarks would make a still background move.
CENTRE_SECONDS = 0.3
#: Most threads; each frame's work is mostly OpenCV and compiled code, which let others run.
MOST_THREADS = 4
# Frames that are worked on ahead of the one that is asked for, for each thread.
_AHEAD = 4

Frame = TypeVar("Frame")
Result = TypeVar("Result")


@dataclass(frozen=True)
class CropWindows:
    """One square window for each frame, of one size, at whole pixels.

    Whole pixels and one size mean that all frames are resampled alike: no frame is sharper than
    another, and the focal length of the cropped camera is constant.
    """

    #: (F, 2) int64, x and y of the top left corner; may lie outside the image.
    corners: np.ndarray
    #: Pixels of the whole frame.
    side: int
    #: Pixels of the resampled crop.
    size: int

    def place(
        self, pixels: np.ndarray, edge: int | None = None, frame: int | slice = slice(None)
    ) -> np.ndarray:
        """Move (F, P, 2) px of the whole frames, or (P, 2) of one, to crops of `edge` px."""
        corners = self.corners[frame][..., None, :]
        return (pixels - corners) * ((edge or self.size) / self.side)

    def intrinsics(self, K: np.ndarray) -> np.ndarray:
        """Camera matrices of the cropped frames, (F, 3, 3), of that of the whole frame, (3, 3) px.

        Pixel centres are at +0.5 in both images, so cropping is a shift and resampling a scale,
        with no half-pixel term.
        """
        matrices = np.tile(K, (len(self.corners), 1, 1))
        matrices[:, :2, 2] -= self.corners
        matrices[:, :2] *= self.size / self.side
        return matrices


def follow_hands(hands: Sequence[Landmarks], fps: float, size: int) -> CropWindows:
    """Choose windows that hold all landmarks of one hand or two in every detected frame.

    A hand that is not detected in a frame is expected between the places where it is, so that the
    window does not jump to the other hand and back.

    Args:
        size: px of the resampled crop.
    """
    from scipy.ndimage import gaussian_filter1d

    detected = np.any([hand.detected for hand in hands], axis=0)
    seen = np.flatnonzero(detected)
    boxes = [_boxes(hand, seen) for hand in hands]
    low = np.min([box[0] for box in boxes], axis=0)
    high = np.max([box[1] for box in boxes], axis=0)
    middle = (low + high) / 2.0
    path = interpolate(middle, seen, len(detected))
    path = gaussian_filter1d(path, sigma=CENTRE_SECONDS * fps, axis=0, mode="nearest")
    reach = np.maximum(high - path[seen], path[seen] - low).max()
    side = max(int(np.ceil(2.0 * reach * (1.0 + MARGIN))), 2)
    return CropWindows(np.round(path - side / 2.0).astype(np.int64), side, size)


def _boxes(hand: Landmarks, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a hand's box in some frames, px, interpolated where it is not detected."""
    own = np.flatnonzero(hand.detected)
    points = hand.image[own]
    low, high = (
        interpolate(corner, own, len(hand.score))[frames]
        for corner in (points.min(axis=1), points.max(axis=1))
    )
    return low, high


def cut(image: np.ndarray, corner: np.ndarray, side: int) -> np.ndarray:
    """Copy a square of `side` px, whose corner is x, y, out of an image; outside it is black."""
    height, width = image.shape[:2]
    x, y = int(corner[0]), int(corner[1])
    square = np.zeros((side, side, *image.shape[2:]), dtype=image.dtype)
    left, right = max(x, 0), min(x + side, width)
    top, bottom = max(y, 0), min(y + side, height)
    if left < right and top < bottom:
        square[top - y : bottom - y, left - x : right - x] = image[top:bottom, left:right]
    return square


def resample(square: np.ndarray, size: int) -> np.ndarray:
    """Resample a square uint8 image: by area where it shrinks (no aliasing), else linearly."""
    import cv2

    if square.shape[0] == size:
        return square
    method = cv2.INTER_AREA if size < square.shape[0] else cv2.INTER_LINEAR
    return cv2.resize(square, (size, size), interpolation=method)


def cells(places: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pixels that places (P, 2) px lie in: rows, columns, and whether the image has them.

    Rows and columns of places outside of an image of this shape are those of its border.
    """
    size = np.array([shape[1], shape[0]])
    cell = np.floor(places)
    inside = ((cell >= 0) & (cell < size)).all(axis=1)
    columns, rows = np.clip(cell, 0, size - 1).astype(np.int64).T
    return rows, columns, inside


def each_frame(work: Callable[[Frame], Result], frames: Iterable[Frame]) -> Iterator[Result]:
    """Call a function for each frame in several threads."""
    threads = min(MOST_THREADS, os.cpu_count() or 1)
    running: list[Future[Result]] = []
    with ThreadPoolExecutor(threads) as pool:
        try:
            for frame in frames:
                running.append(pool.submit(work, frame))
                if len(running) > threads * _AHEAD:
                    yield running.pop(0).result()
            while running:
                yield running.pop(0).result()
        finally:
            for future in running:
                future.cancel()


def ahead(frames: Generator[Frame]) -> Iterator[Frame]:
    """Compute the next frame in another thread while the caller works on this one.

    All of the generator runs in that thread, its end too.
    """
    with ThreadPoolExecutor(1) as pool:
        running = deque(pool.submit(next, frames, None) for _ in range(2))
        try:
            while (frame := running.popleft().result()) is not None:
                running.append(pool.submit(next, frames, None))
                yield frame
        finally:
            for future in running:
                future.cancel()
            pool.submit(frames.close).result()
