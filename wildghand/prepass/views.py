"""How many frames' worth of views each place of the hand has."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

# Pixels of a cell that a frame must show to count as a view of it.
_LEAST_PIXELS = 2
# Rounds in which vertices take the mean of themselves and their neighbours: cells are small, and
# which of them catches a pixel is chance.
_ROUNDS = 2


def seen_cells(cells: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """The cells of the surface that a frame shows.

    Args:
        cells: (P,) cell of each pixel.
        shown: (P,) bool, the pixel can be trusted to show it.

    Returns:
        Ascending int64 numbers of cells.
    """
    found, pixels = np.unique(cells[shown], return_counts=True)
    return found[pixels >= _LEAST_PIXELS].astype(np.int64)


def views_of_vertices(
    seen: Iterable[np.ndarray],
    weights: Iterable[float],
    vertex_cells: Mapping[str, np.ndarray],
    faces: Mapping[str, np.ndarray],
    cell_count: int,
) -> dict[str, np.ndarray]:
    """Sum of the weights of the frames that show each vertex.

    Args:
        seen: for each frame the cells that it shows.
        weights: of the frames.
        vertex_cells: by side (V,) the cell of every vertex.
        faces: by side (F, 3) vertices.
        cell_count: number of cells.

    Returns:
        By side (V,) not negative: frames' worth of views.
    """
    views = np.zeros(cell_count)
    for cells, weight in zip(seen, weights, strict=True):
        views[cells] += weight
    return {side: _smooth(views[cells], faces[side]) for side, cells in vertex_cells.items()}


def _smooth(values: np.ndarray, faces: np.ndarray) -> np.ndarray:
    starts = faces[:, [0, 1, 2, 1, 2, 0]].reshape(-1)
    ends = faces[:, [1, 2, 0, 0, 1, 2]].reshape(-1)
    degree = 1.0 + np.bincount(starts, minlength=len(values))
    for _ in range(_ROUNDS):
        around = np.bincount(starts, values[ends], minlength=len(values))
        values = (values + around) / degree
    return values
