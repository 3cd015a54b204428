"""Soft shapes painted over a picture, only where they are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

#: Opacity and shade at places relative to the shape: right and down, (h, w) each.
Cover = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def paint(
    image: np.ndarray,
    places: tuple[np.ndarray, np.ndarray],
    at: tuple[float, float],
    reach: float,
    color: np.ndarray,
    cover: Cover,
) -> None:
    """Paint one shape into an image.

    Args:
        image: (H, W, 3) linear, is changed.
        places: x and y (H, W) of the pixels, nearly the same down each column and each row.
        at: the shape's middle.
        reach: farthest that it extends from there.
        color: (3,) linear.
        cover: opacity 0-1 and a factor on the colour at each place.
    """
    x, y = places
    rows = np.flatnonzero(np.abs(y[:, [0, -1]] - at[1]).min(axis=1) < reach)
    columns = np.flatnonzero(np.abs(x[[0, -1]] - at[0]).min(axis=0) < reach)
    if not len(rows) or not len(columns):
        return
    part = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    opacity, shade = cover(x[part] - at[0], y[part] - at[1])
    target = image[part]
    target += opacity[..., None] * (shade[..., None] * color - target)
