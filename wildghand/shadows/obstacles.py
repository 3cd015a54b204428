"""Posed hands that stand in the light."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hwp_bench.base.rays import ray_mesh

#: How far a ray starts from the skin, m: the surface of an estimated hand is not exact, and a
#: fold must not shade itself.
LIFT = 2e-3
# Cosine between normal and direction up to which a place has no light from there anyway.
_GRAZING = 0.02


def obstacles_in_frames(
    surfaces: Sequence[tuple[np.ndarray, np.ndarray]],
) -> Iterator[Obstacles]:
    """The hands of one frame after the other.

    Args:
        surfaces: (B, V, 3) m in B frames and (F, 3) of each hand, at least one.
    """
    for frame in range(len(surfaces[0][0])):
        yield Obstacles([(vertices[frame], faces) for vertices, faces in surfaces])


class Obstacles:
    """The surfaces of one hand or two in one pose.

    Args:
        surfaces: (V, 3) m and (F, 3) of each hand.

    Raises:
        HwpError: Embree refuses the mesh.
    """

    def __init__(self, surfaces: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
        starts = np.cumsum([0, *(len(vertices) for vertices, _ in surfaces)])
        self._mesh = ray_mesh(
            np.concatenate([vertices for vertices, _ in surfaces]),
            np.concatenate([faces + s for (_, faces), s in zip(surfaces, starts, strict=False)]),
        )

    def free(self, points: np.ndarray, normals: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Whether light from far away reaches places of the surface.

        Args:
            points: (M, 3) m.
            normals: (M, 3) of length 1.
            directions: (K, 3) towards the light, of length 1.

        Returns:
            (M, K) float64, 0 where a hand is in the way and 1 elsewhere, also where the place
            faces away from the light.
        """
        free = np.ones((len(points), len(directions)))
        place, way = np.nonzero(normals @ directions.T > _GRAZING)
        starts = (points + LIFT * normals)[place].astype(np.float64)
        blocked = self._mesh.blocked(starts, directions[way].astype(np.float64))
        free[place[blocked], way[blocked]] = 0.0
        return free
