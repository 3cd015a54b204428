"""The outline of the posed mesh in the picture: drawing it, and the vertices that lie on it."""

from __future__ import annotations

import numpy as np
from numba import njit


def draw_silhouette(pixels: np.ndarray, faces: np.ndarray, size: int) -> np.ndarray:
    """Draw the area that a mesh covers: pixels whose centre lies in a triangle.

    OpenCV's polygons are no substitute: they also fill pixels that the outline touches, which
    makes every hand half a pixel too thick.

    Args:
        pixels: (V, 2) vertices in the picture, px; pixel centres at +0.5.
        faces: (F, 3) int, either orientation.
        size: edge of the square picture, px.

    Returns:
        (size, size) uint8, 255 where the mesh is. Triangles with a corner that is not finite
        are left out.
    """
    picture = np.zeros((size, size), dtype=np.uint8)
    corners = np.asarray(pixels, dtype=np.float64)[faces]
    _fill(picture, corners[np.isfinite(corners).all(axis=(1, 2))])
    return picture


@njit(nogil=True)
def _fill(picture: np.ndarray, triangles: np.ndarray) -> None:
    size = picture.shape[0]
    for t in range(triangles.shape[0]):
        x0, y0 = triangles[t, 0]
        x1, y1 = triangles[t, 1]
        x2, y2 = triangles[t, 2]
        area = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)
        if area == 0.0:
            continue
        sign = 1.0 if area > 0.0 else -1.0
        left = int(max(np.floor(min(x0, x1, x2) - 0.5), 0.0))
        right = int(min(np.ceil(max(x0, x1, x2) - 0.5), size - 1.0))
        top = int(max(np.floor(min(y0, y1, y2) - 0.5), 0.0))
        bottom = int(min(np.ceil(max(y0, y1, y2) - 0.5), size - 1.0))
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                if (
                    sign * ((x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)) >= 0.0
                    and sign * ((x2 - x1) * (y - y1) - (y2 - y1) * (x - x1)) >= 0.0
                    and sign * ((x0 - x2) * (y - y2) - (y0 - y2) * (x - x2)) >= 0.0
                ):
                    picture[row, column] = 255


def boundary_vertices(faces: np.ndarray) -> np.ndarray:
    """Vertices on the open end of a mesh (the wrist): those of edges with one face, sorted."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    return np.unique(unique[count == 1])


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Intersection over union of two bool arrays; 1 where both are empty."""
    union = np.count_nonzero(first | second)
    return 1.0 if union == 0 else np.count_nonzero(first & second) / union
