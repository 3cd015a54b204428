"""The pixels that scoring looks at: the images that it accepts, the scored region and its box.

Images are 8-bit sRGB, (H, W, 3), and all of one size.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hwp_bench.base.errors import BadImage, BadPrediction, EmptyMask, ShapeMismatch

#: A mask value above this means "hand".
MASK_THRESHOLD = 127


def check_truth(target: np.ndarray, mask: np.ndarray) -> None:
    """Refuse a target and mask that cannot be scored against.

    Args:
        target: (H, W, 3) uint8.
        mask: (H, W) uint8 or bool.

    Raises:
        BadImage: a type is wrong.
        ShapeMismatch: a shape is wrong.
    """
    if target.dtype != np.uint8:
        raise BadImage(f"the target is {target.dtype}, not uint8", field="target")
    if target.ndim != 3 or target.shape[2] != 3 or target.size == 0:
        raise ShapeMismatch(f"the target is {target.shape}, not (H, W, 3)", field="target")
    if mask.dtype not in (np.uint8, np.bool_):
        raise BadImage(f"the mask is {mask.dtype}, not uint8 or bool", field="mask")
    if mask.shape != target.shape[:2]:
        raise ShapeMismatch(
            f"the mask is {mask.shape}, the target {target.shape[:2]}", field="mask"
        )


def check_prediction(prediction: np.ndarray, target: np.ndarray) -> None:
    """Refuse a prediction that is not an image like `target`.

    Raises:
        BadPrediction: the type is not uint8.
        ShapeMismatch: the shape differs from the target's; nothing is ever resized.
    """
    if prediction.dtype != np.uint8:
        raise BadPrediction(
            f"the prediction is {prediction.dtype}, not uint8",
            field="prediction",
            remedy="Convert float images with hwp_bench.base.images.as_uint8.",
        )
    if prediction.shape != target.shape:
        raise ShapeMismatch(
            f"the prediction is {prediction.shape}, the target {target.shape}",
            field="prediction",
            remedy="Predict at the target's own resolution, three channels.",
        )


def check_same_shape(
    prediction: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None
) -> None:
    """Refuse arrays that do not describe one image.

    Args:
        prediction: (H, W, 3).
        target: (H, W, 3).
        mask: (H, W), or None.

    Raises:
        ShapeMismatch: they differ, or are not of that form.
    """
    if prediction.shape != target.shape or target.ndim != 3:
        raise ShapeMismatch(
            f"prediction and target are {prediction.shape} and {target.shape}, not both (H, W, 3)"
        )
    if mask is not None and mask.shape != target.shape[:2]:
        raise ShapeMismatch(f"the mask is {mask.shape}, the image {target.shape[:2]}", field="mask")


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
