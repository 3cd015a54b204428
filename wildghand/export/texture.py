"""The colours of Gaussians as a texture of the hand's mesh."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.nearest import kd_tree

#: Texels along an edge.
SIZE = 512
# Gaussians that a texel mixes.
_NEAREST = 6


def baked(
    uv: np.ndarray, colors: np.ndarray, opacities: np.ndarray, size: int = SIZE
) -> np.ndarray:
    """Mix the nearest Gaussians into each texel.

    Args:
        uv: (N, 2) texture coordinates of the Gaussians' anchors, in [0, 1], origin at the bottom
            left.
        colors: (N, 3) sRGB.
        opacities: (N,) in [0, 1].
        size: texels along an edge.

    Returns:
        (size, size, 3) uint8 sRGB, row 0 at the top (v = 1).
    """
    place = (np.arange(size) + 0.5) / size
    columns, rows = np.meshgrid(place, 1.0 - place)
    texels = np.stack((columns.ravel(), rows.ravel()), axis=1)
    count = min(_NEAREST, len(uv))
    distance, index = kd_tree(uv.astype(np.float64)).query(texels, k=count)
    distance, index = distance.reshape(-1, count), index.reshape(-1, count)
    # Half a texel: a Gaussian in the middle of a texel does not outweigh all others.
    weights = opacities[index].astype(np.float64) / (distance + 0.5 / size) ** 2 + 1e-12
    mixed = (colors[index] * weights[..., None]).sum(axis=1) / weights.sum(axis=1, keepdims=True)
    return np.rint(255.0 * mixed.clip(0.0, 1.0)).astype(np.uint8).reshape(size, size, 3)
