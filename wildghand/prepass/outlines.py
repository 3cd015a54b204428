"""Mask against silhouette: a hand that is somewhere else, or a part of it that is hidden."""

from __future__ import annotations

import cv2
import numpy as np

# What silhouette and mask differ by at a sound border, px.
_SLACK = 1


def misplacement(mask: np.ndarray, silhouette: np.ndarray) -> float:
    """Mean distance by which the mask lies outside the silhouette.

    A misplaced hand leaves its silhouette on one side as it lacks it on the other; something in
    front takes from the mask and adds nothing outside. So the outside alone tells them apart.

    Args:
        mask: (H, W) bool, visible hand.
        silhouette: (H, W) bool, the estimated hands; not empty.

    Returns:
        Share of the hand's size, the square root of its area. Differences of `_SLACK` px at the
        border are not counted.
    """
    near = _grow(silhouette, _SLACK)
    outside = float(np.count_nonzero(mask & ~near))
    ring = float(np.count_nonzero(near & ~silhouette))
    return outside / max(ring, 1.0) / float(np.sqrt(np.count_nonzero(silhouette)))


class ShownCells:
    """How often each cell of the surface is in the mask when it is in the silhouette.

    What no mask shows (the wrist inside a sleeve) cannot be hidden.
    """

    def __init__(self, cell_count: int) -> None:
        self._drawn = np.zeros(cell_count, dtype=np.int64)
        self._shown = np.zeros(cell_count, dtype=np.int64)

    def add(self, cells: np.ndarray, masked: np.ndarray) -> None:
        """Count one frame: (P,) cells of its pixels and (P,) bool whether the mask has them."""
        self._drawn += np.bincount(cells, minlength=len(self._drawn))
        self._shown += np.bincount(cells[masked], minlength=len(self._drawn))

    def hidden_share(self, cells: np.ndarray, masked: np.ndarray) -> float:
        """Share of a frame's pixels that other frames show and its mask lacks."""
        known = 2 * self._shown[cells] > self._drawn[cells]
        lacking = int(np.count_nonzero(known & ~masked))
        return lacking / max(int(np.count_nonzero(known)), 1)


def interior(area: np.ndarray, margin: int) -> np.ndarray:
    """(H, W) bool: the pixels of an area that lie more than `margin` px inside; 1 at least."""
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    # Beyond the border of the picture the hand goes on.
    eroded = cv2.erode(area.astype(np.uint8), shape, borderType=cv2.BORDER_REPLICATE)
    return eroded.astype(bool)


def _grow(area: np.ndarray, margin: int) -> np.ndarray:
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    return cv2.dilate(area.astype(np.uint8), shape).astype(bool)
