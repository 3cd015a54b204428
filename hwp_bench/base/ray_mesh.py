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
        self._vertices = np.ascontiguousarray(vertices, dtype=np.float32)
        self._faces = np.ascontiguousarray(faces, dtype=np.int32)
        self._mesh = TriangleMesh(self._scene, self._vertices, self._faces)

    def first_hits(self, origins: np.ndarray, directions: np.ndarray) -> Met:
        """The first face on each ray: (ray, face, u, v, distance), each (H,)."""
        from hwp_bench.base.on_face import places_on_faces

        rays = _rays(origins, directions)
        met = self._scene.run(*rays, output=False)
        ray = np.flatnonzero(met >= 0)
        face = met[ray].astype(np.int64)
        return ray, face, *places_on_faces(self._vertices, self._faces, *rays, ray, face)

    def blocked(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Whether anything is in each ray's way: (N,) bool."""
        if not len(directions):
            return np.zeros(0, dtype=bool)
        found = self._scene.run(*_rays(origins, directions), query="OCCLUDED")
        return np.asarray(found) >= 0


def _rays(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    starts = np.broadcast_to(origins, directions.shape)
    return tuple(np.ascontiguousarray(rays, np.float32) for rays in (starts, directions))  # type: ignore[return-value]
