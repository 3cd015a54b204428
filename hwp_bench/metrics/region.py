"""The scored region: which pixels of a frame count, and the box around them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hwp_bench.base.errors import EmptyMask

#: A mask value above this means "hand".
MASK_THRESHOLD = 127


@dataclass(frozen=True)
class Box:
    """A rectangle of pixels; it may reach beyond the frame, where everything is black."""

    #: First row.
    top: int
    #: First column.
    left: int
    #: Row after the last.
    bottom: int
    #: Column after the last.
    right: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.bottom - self.top, self.right - self.left

    @property
    def area(self) -> int:
        """Number of pixels, those beyond the frame included."""
        rows, columns = self.shape
        return rows * columns

    def grown(self, pixels: int) -> Box:
        """The box with `pixels` more on every side."""
        return Box(self.top - pixels, self.left - pixels, self.bottom + pixels, self.right + pixels)

    def at_least(self, side: int) -> Box:
        """The box grown evenly until both sides have `side` pixels (an odd one goes below)."""
        rows, columns = (max(0, side - length) for length in self.shape)
        return Box(
            self.top - rows // 2,
            self.left - columns // 2,
            self.bottom + rows - rows // 2,
            self.right + columns - columns // 2,
        )


def hand_pixels(mask: np.ndarray) -> np.ndarray:
    """The pixels that show the hand, mixed border pixels included.

    Args:
        mask: (H, W) uint8 (above 127 is hand) or bool.

    Returns:
        (H, W) bool.
    """
    return mask if mask.dtype == np.bool_ else mask > MASK_THRESHOLD


def scored_pixels(mask: np.ndarray, *, erosion: int, coverage: bool = False) -> np.ndarray:
    """The pixels that the hand covers fully.

    A quarter of the squared error otherwise sits in border pixels that mix hand and
    background, and measures the background.

    Args:
        mask: (H, W) uint8 or bool, the data set's own visible-hand mask.
        erosion: pixels that the mask loses at its border, to all eight neighbours; the frame's
            border takes nothing away, because the hand goes on behind it.
        coverage: True where `mask` says which share of a pixel the hand covers (255 = all):
            then the pixels at 255 are taken as they are, without erosion.

    Returns:
        (H, W) bool; may be empty.
    """
    if coverage:
        return mask.copy() if mask.dtype == np.bool_ else mask == 255
    hand = hand_pixels(mask)
    if erosion == 0:
        return hand
    side = 2 * erosion + 1
    kernel = np.ones((side, side), np.uint8)
    return cv2.erode(hand.astype(np.uint8), kernel).astype(bool)


def bounding_box(region: np.ndarray) -> Box:
    """The smallest box around the True pixels of `region` (H, W) bool.

    Raises:
        EmptyMask: there are none.
    """
    rows = np.flatnonzero(region.any(axis=1))
    columns = np.flatnonzero(region.any(axis=0))
    if rows.size == 0:
        raise EmptyMask(
            "no pixel is left to score",
            field="mask",
            remedy="The mask shows no hand, or a hand thinner than three pixels.",
        )
    return Box(int(rows[0]), int(columns[0]), int(rows[-1]) + 1, int(columns[-1]) + 1)


def crop(image: np.ndarray, box: Box) -> np.ndarray:
    """The pixels of `box`, zero (black, or False) where it leaves the frame.

    Args:
        image: (H, W) or (H, W, C), any type.
        box: rows and columns to take.

    Returns:
        a new array of shape `box.shape` + trailing axes, same type.
    """
    height, width = image.shape[:2]
    out = np.zeros(box.shape + image.shape[2:], image.dtype)
    top, bottom = max(box.top, 0), min(box.bottom, height)
    left, right = max(box.left, 0), min(box.right, width)
    if top < bottom and left < right:
        inside = out[top - box.top : bottom - box.top, left - box.left : right - box.left]
        inside[...] = image[top:bottom, left:right]
    return out


def composite(image: np.ndarray, region: np.ndarray) -> np.ndarray:
    """`image` (H, W, C) where `region` (H, W) bool is True, black elsewhere; a new array."""
    return cv2.copyTo(image, region.view(np.uint8))
