"""Meshes that rays are cast against, by Embree as this machine has it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from hwp_bench.base.embree import EmbreeMesh, Met


def ray_mesh(vertices: np.ndarray, faces: np.ndarray) -> EmbreeMesh | EmbreexMesh:
    """Make a mesh ready to be asked what rays meet.

    Args:
        vertices: (V, 3) m.
        faces: (F, 3) vertex indices.

    Raises:
        HwpError: Embree refuses the mesh.
    """
    from hwp_bench.base.embree import EmbreeMesh, library

    loaded = library()
    return EmbreexMesh(vertices, faces) if loaded is None else EmbreeMesh(loaded, vertices, faces)


class EmbreexMesh:
    """What `EmbreeMesh` does, through the package embreex alone: slower, the same hits.

    Args:
        vertices: (V, 3) m.
        faces: (F, 3) vertex indices.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(
            self._scene,
            np.ascontiguousarray(vertices, dtype=np.float32),
            np.ascontiguousarray(faces, dtype=np.int32),
        )

    def first_hits(self, origins: np.ndarray, directions: np.ndarray) -> Met:
        """The first face on each ray: (ray, face, u, v, distance), each (H,)."""
        found = self._scene.run(*_rays(origins, directions), output=True)
        ray = np.flatnonzero(found["primID"] >= 0)
        return ray, *(found[name][ray] for name in ("primID", "u", "v", "tfar"))

    def blocked(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Whether anything is in each ray's way: (N,) bool."""
        if not len(directions):
            return np.zeros(0, dtype=bool)
        found = self._scene.run(*_rays(origins, directions), query="OCCLUDED")
        return np.asarray(found) >= 0


def _rays(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    starts = np.broadcast_to(origins, directions.shape)
    return tuple(np.ascontiguousarray(rays, np.float32) for rays in (starts, directions))  # type: ignore[return-value]
