"""Rolling shutter: a surface as a sensor sees it that reads its rows one after another.

A point is seen in the row that is read when the point is there. So each vertex is put where it
stands, relative to the camera, when its own row is read; one picture of that surface then shows
every row at its own time, whatever hands, objects and camera do.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hwp_bench.sim.picture import Lens
from hwp_bench.sim.stage import between
from hwp_bench.sim.surface import Surface, transformed

# Rounds in which place and time of a vertex find each other. Each shrinks the error by the way
# that the vertex moves down the picture during the readout, in heights of the picture.
_ROUNDS = 4

#: A surface at three instants, in the camera's axes at each: opening, middle, closing.
Knots = tuple[Surface, Surface, Surface]


def knots(
    surface_at: Callable[[float], Surface], view_at: Callable[[float], np.ndarray], reach: float
) -> Knots:
    """Take a surface at three instants, in the camera's axes.

    Args:
        surface_at: the surface at a time, world.
        view_at: (4, 4) world to camera at a time.
        reach: the times are -reach / 2, 0 and reach / 2.
    """
    first, middle, last = (
        transformed(surface_at(time), view_at(time)) for time in (-reach / 2.0, 0.0, reach / 2.0)
    )
    return first, middle, last


def row_by_row(at: Knots, reach: float, time: float, readout: float, lens: Lens) -> Surface:
    """A surface with every vertex where it stands when its row is read.

    Args:
        at: the surface at three instants; it moves on parabolas between.
        reach: time from the first of them to the last.
        time: when the middle row is read, 0 at the second instant.
        readout: time from the first row to the last, in the unit of the others.
        lens: the camera, whose view is that of `time`.

    Returns:
        The surface in the world, to be seen through `lens` as if all rows were read at once.
    """
    moments = np.full((len(at[0].vertices), 1), time)
    for _ in range(_ROUNDS):
        places = between(at, moments / reach).vertices
        row = lens.K[1, 1] * places[:, 1] / places[:, 2] + lens.K[1, 2]
        moments[:, 0] = time + (np.clip(row / lens.size, 0.0, 1.0) - 0.5) * readout
    return transformed(between(at, moments / reach), np.linalg.inv(lens.view))
