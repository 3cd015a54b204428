"""The hand's border in an image and in its mask: its width, its place, and the parts that hide."""

from __future__ import annotations

import cv2
import numpy as np

from hwp_bench.base.colors import srgb_to_linear

# Reach of a profile to either side of the border, share of the image's edge.
_REACH = 0.1
# Step along a profile, px.
_STEP = 0.5
# Least difference between inside and outside, sRGB in [0, 1].
_CONTRAST = 0.12
# Directions are told apart modulo a half turn in so many bins.
_BINS = 6
# Profiles of a frame.
_POINTS = 250
# Profiles that a bin needs.
_LEAST = 6

# Difference of silhouette and mask at a sound border, px.
_SLACK = 1


def border_width(image: np.ndarray, mask: np.ndarray) -> float:
    """Width of the border between hand and background, in its most blurred direction.

    Profiles across the outline of the mask are projected on the difference of the colours at
    their ends and scaled to a range of 1, so that their steepest slope gives the width:
    1 / slope. The outline itself may be off by some pixels. Widths are medians over the profiles
    of similar direction.

    Args:
        image: (H, W, 3) uint8.
        mask: (H, W) bool, visible hand.

    Returns:
        px; NaN where too little of the border can be read.
    """
    reach = max(4.0, _REACH * max(mask.shape))
    points, directions = _outline(mask)
    if len(points) < _LEAST:
        return float("nan")
    steps = np.arange(-reach, reach + 0.5 * _STEP, _STEP)
    places = (points[:, None] + steps[None, :, None] * directions[:, None]).astype(np.float32)
    size = np.array(mask.shape[::-1]) - 1.0
    inside = ((places >= 0.0) & (places <= size)).all(axis=(1, 2))
    places, directions = places[inside], directions[inside]
    if len(places) < _LEAST:
        return float("nan")
    profiles = (
        cv2.remap(
            image,
            np.ascontiguousarray(places[..., 0]),
            np.ascontiguousarray(places[..., 1]),
            cv2.INTER_LINEAR,
        ).astype(np.float32)
        / 255.0
    )
    third = len(steps) // 3
    inner, outer = profiles[:, :third].mean(axis=1), profiles[:, -third:].mean(axis=1)
    clear = np.linalg.norm(inner - outer, axis=1) > _CONTRAST
    if np.count_nonzero(clear) < _LEAST:
        return float("nan")
    # Shutters add up light, so that a streak is a straight ramp in light, not in sRGB.
    profiles = srgb_to_linear(profiles[clear])
    way = profiles[:, :third].mean(axis=1) - profiles[:, -third:].mean(axis=1)
    along = np.einsum("nsk,nk->ns", profiles, way / np.linalg.norm(way, axis=1)[:, None])
    along /= np.maximum(np.ptp(along, axis=1), 1e-6)[:, None]
    # Differences over 2 px: noise counts less, and a sharp border is that wide anyway.
    gap = round(2.0 / _STEP)
    slope = np.abs(along[:, gap:] - along[:, :-gap]).max(axis=1) / (gap * _STEP)
    width = 1.0 / np.maximum(slope, 0.5 / reach)
    angle = np.mod(np.arctan2(directions[clear, 1], directions[clear, 0]), np.pi)
    bins = np.minimum((angle / np.pi * _BINS).astype(np.int64), _BINS - 1)
    medians = [np.median(width[bins == k]) for k in range(_BINS) if (bins == k).sum() >= _LEAST]
    return float(max(medians)) if medians else float(np.median(width))


def misplacement(mask: np.ndarray, silhouette: np.ndarray) -> float:
    """Mean distance by which the mask lies outside the silhouette.

    The mask of a misplaced hand lies outside the silhouette on one side and lacks a part of it on
    the other. An object in front removes pixels from the mask and adds none outside. So only the
    outside tells them apart.

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

    A cell that no mask shows (the wrist inside a sleeve) does not count as hidden.
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
    # The hand goes on beyond the border of the image.
    eroded = cv2.erode(area.astype(np.uint8), shape, borderType=cv2.BORDER_REPLICATE)
    return eroded.astype(bool)


def _outline(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2) pixels (x, y) on the outline and (N, 2) unit directions outward."""
    solid = mask.astype(np.uint8)
    inward = cv2.distanceTransform(solid, cv2.DIST_L2, 3)
    outward = cv2.distanceTransform(1 - solid, cv2.DIST_L2, 3) - inward
    smooth = cv2.GaussianBlur(outward, (0, 0), 2.0)
    rows, columns = np.nonzero(mask & (outward > -1.5))
    every = max(2, len(rows) // _POINTS)
    rows, columns = rows[::every], columns[::every]
    slope = np.stack(
        [
            cv2.Sobel(smooth, cv2.CV_32F, 1, 0)[rows, columns],
            cv2.Sobel(smooth, cv2.CV_32F, 0, 1)[rows, columns],
        ],
        axis=1,
    )
    length = np.linalg.norm(slope, axis=1)
    sound = length > 1e-3
    points = np.stack([columns, rows], axis=1)[sound].astype(np.float64)
    return points, slope[sound] / length[sound, None]


def _grow(area: np.ndarray, margin: int) -> np.ndarray:
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    return cv2.dilate(area.astype(np.uint8), shape).astype(bool)
