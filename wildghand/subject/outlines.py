"""Outlines: where the border of a drawn hand lies against the border of a mask."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from hwp_bench.hands.raster import draw_faces

# Outlines nearer to the image's edge than this say nothing, px.
_EDGE = 3
# Standard deviation of the smoothing before an outline's direction is read, px.
_SMOOTH = 1.5
# Pixels around a drawing beyond which nothing changes at its outline: the smoothing reads 4 px.
_MARGIN = 6
# Least cosine between the outward directions of drawing and mask.
_ALIKE = 0.6


@dataclass(frozen=True, eq=False)
class OutlinePoints:
    """M points of the outline of the drawn hands in one frame."""

    #: (M,) face of the mesh that each point is on.
    face: np.ndarray
    #: (M, 3) barycentric coordinates.
    mix: np.ndarray
    #: (M, 2) unit vectors in the image, outward.
    outward: np.ndarray
    #: (M,) px that the mask's border lies farther out.
    gap: np.ndarray


@dataclass(frozen=True, eq=False)
class MaskOutline:
    """The outline of a mask, read once for many drawings."""

    #: (H, W) float32 px from the border, as `outward_distance`.
    distance: np.ndarray
    #: The same, smoothed: its slope is the outward direction.
    smooth: np.ndarray
    #: Whether there is a border at all.
    bordered: bool

    @classmethod
    def of(cls, mask: np.ndarray) -> MaskOutline:
        """Read the outline of a mask, (H, W) bool, visible hand."""
        distance = outward_distance(mask)
        smooth = _smoothed(distance).astype(np.float32)
        return cls(distance.astype(np.float32), smooth, bool(mask.any() and not mask.all()))


def compare_outlines(
    pixels: np.ndarray, depth: np.ndarray, faces: np.ndarray, outline: MaskOutline
) -> OutlinePoints:
    """Compare the outline of a mesh with that of a mask.

    Args:
        pixels: (V, 2) px, the mesh in the image.
        depth: (V,) m.
        faces: (F, 3).
        outline: of the mask.

    Returns:
        The points where both outlines run alike. Distances of both are read in the same way, so
        that the rounding to pixels is the same.
    """
    face, mix = draw_faces(pixels, depth, faces, outline.distance.shape)
    area = face >= 0
    # Without a border OpenCV's distances are as large as numbers get, and their slope is noise.
    if not (area.any() and outline.bordered):
        return OutlinePoints(
            face=np.zeros(0, dtype=np.int32),
            mix=np.zeros((0, 3)),
            outward=np.zeros((0, 2)),
            gap=np.zeros(0),
        )
    window = _around(area)
    drawn = area[window]
    mine = outward_distance(drawn)
    rim = np.zeros(area.shape, dtype=bool)
    rim[window] = drawn & (mine > -0.7)
    rim[:_EDGE] = rim[-_EDGE:] = False
    rim[:, :_EDGE] = rim[:, -_EDGE:] = False
    places = np.nonzero(rim)
    within = tuple(place - part.start for place, part in zip(places, window, strict=True))
    here = _direction(_smoothed(mine), *within)
    there = _direction(outline.smooth, *places)
    gap = mine[within] - outline.distance[places]
    alike = (here * there).sum(axis=1) > _ALIKE
    rows, columns = (place[alike] for place in places)
    second = mix[rows, columns]
    return OutlinePoints(
        face=face[rows, columns],
        mix=np.column_stack([1.0 - second.sum(axis=1), second]),
        outward=here[alike],
        gap=gap[alike],
    )


def _around(area: np.ndarray) -> tuple[slice, slice]:
    """The rows and columns of a bool area, not empty, and of what its outline is read from."""
    rows, columns = (np.flatnonzero(area.any(axis=axis)) for axis in (1, 0))
    first = max(int(rows[0]) - _MARGIN, 0), max(int(columns[0]) - _MARGIN, 0)
    return (
        slice(first[0], int(rows[-1]) + _MARGIN + 1),
        slice(first[1], int(columns[-1]) + _MARGIN + 1),
    )


def outward_distance(area: np.ndarray) -> np.ndarray:
    """(H, W) float64 px from the border of a bool area: positive outside, negative inside."""
    solid = area.astype(np.uint8)
    inside = cv2.distanceTransform(solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outside = cv2.distanceTransform(1 - solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Squares are integers; OpenCV's last bits depend on where an array lies in memory.
    inside, outside = (np.sqrt(np.rint(part.astype(np.float64) ** 2)) for part in (inside, outside))
    # Distances are between pixel centres; the border lies halfway between two of them.
    result: np.ndarray = np.where(area, 0.5 - inside, outside - 0.5)
    return result


def _smoothed(distance: np.ndarray) -> np.ndarray:
    # SciPy's filter, too, gives the same bits wherever an array lies.
    return np.asarray(gaussian_filter(distance, _SMOOTH, mode="mirror", truncate=2.7))


def _direction(smooth: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """(M, 2) unit gradients (x, y) of a smoothed distance; zeros where it has none."""
    across = smooth[rows, columns + 1] - smooth[rows, columns - 1]
    down = smooth[rows + 1, columns] - smooth[rows - 1, columns]
    length = np.sqrt(across * across + down * down)
    known = length > 1e-3
    length = np.where(known, length, 1.0)
    return (
        np.column_stack([np.where(known, across, 0.0), np.where(known, down, 0.0)])
        / length[:, None]
    )
