"""Where the hand ends and the forearm begins, in the picture."""

from __future__ import annotations

import numpy as np


def beyond_wrist(
    vertices: np.ndarray, pixels: np.ndarray, ring: np.ndarray, size: int
) -> np.ndarray:
    """Pixels on the forearm's side of the wrist.

    The open end of the mesh spans a plane; its normal points along the forearm. Seen at the
    wrist's depth, the plane cuts the picture in a line, and the forearm lies behind the line.

    Args:
        vertices: (V, 3) camera axes, m.
        pixels: (V, 2) px.
        ring: vertices of the open end.
        size: edge of the picture, px.

    Returns:
        (size, size) bool; all False for a mesh without an open end, or seen straight along
        the forearm.
    """
    if len(ring) < 3:
        return np.zeros((size, size), dtype=bool)
    centre = vertices[ring].mean(axis=0)
    normal = np.linalg.svd(vertices[ring] - centre)[2][2]
    if normal @ (vertices.mean(axis=0) - centre) > 0:
        normal = -normal
    middle = pixels[ring].mean(axis=0)
    along = np.arange(size) + 0.5
    depth = (along[None] - middle[0]) * normal[0] + (along[:, None] - middle[1]) * normal[1]
    return depth > 0
