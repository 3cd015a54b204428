"""The outline of the posed mesh in the picture: drawing it, and the vertices that lie on it."""

from __future__ import annotations

import numpy as np

#: Fractional bits of polygon corners in OpenCV's drawing.
_SHIFT = 4


def draw_silhouette(pixels: np.ndarray, faces: np.ndarray, size: int) -> np.ndarray:
    """Draw the area that a mesh covers.

    Args:
        pixels: (V, 2) vertices in the picture, px; pixel centres at +0.5.
        faces: (F, 3) int.
        size: edge of the square picture, px.

    Returns:
        (size, size) uint8, 255 where the mesh is.
    """
    import cv2

    picture = np.zeros((size, size), dtype=np.uint8)
    # OpenCV has pixel centres at whole numbers, and 16-bit arithmetic has an end.
    corners = np.clip((pixels - 0.5) * 2**_SHIFT, -(2**20), 2**20)
    for triangle in np.round(corners).astype(np.int32)[faces]:
        cv2.fillConvexPoly(picture, triangle, 255, shift=_SHIFT)
    return picture


def boundary_vertices(faces: np.ndarray) -> np.ndarray:
    """Vertices on the open end of a mesh (the wrist): those of edges with one face, sorted."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    return np.unique(unique[count == 1])


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Intersection over union of two bool arrays; 1 where both are empty."""
    union = np.count_nonzero(first | second)
    return 1.0 if union == 0 else np.count_nonzero(first & second) / union
