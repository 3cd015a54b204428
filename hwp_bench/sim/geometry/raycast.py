"""Ray casting against triangle meshes, through Embree, with its cost on record."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from hwp_bench.sim.geometry.embree import EmbreeMesh, Met

#: Distance by which secondary rays leave their surface, m; below it a hand shades itself.
LIFT = 4e-4


@dataclass(frozen=True)
class Hits:
    """The points where rays meet a mesh."""

    #: (H,) index of the ray.
    ray: np.ndarray
    #: (H,) face that was hit first.
    face: np.ndarray
    #: (H, 3) barycentric weights of the face's corners.
    weights: np.ndarray
    #: (H,) distance in lengths of the ray's direction.
    distance: np.ndarray


class Tracer:
    """One mesh, ready to be asked what rays meet.

    Args:
        vertices: (V, 3) m.
        faces: (F, 3) vertex indices.
        rays: counts rays by purpose.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, rays: Counter[str]) -> None:
        from hwp_bench.sim.geometry.embree import EmbreeMesh, library

        loaded = library()
        self._mesh: EmbreeMesh | EmbreexMesh = (
            EmbreexMesh(vertices, faces) if loaded is None else EmbreeMesh(loaded, vertices, faces)
        )
        self._rays = rays

    def first_hits(self, origins: np.ndarray, directions: np.ndarray, purpose: str) -> Hits:
        """Find the first face on every ray.

        Args:
            origins: (N, 3) m, or (1, 3) for all rays.
            directions: (N, 3), any length.
            purpose: under which the rays are counted.
        """
        self._rays[purpose] += len(directions)
        ray, face, u, v, distance = self._mesh.first_hits(origins, directions)
        return Hits(ray, face, np.stack([1.0 - u - v, u, v], axis=1), distance)

    def blocked(self, origins: np.ndarray, directions: np.ndarray, purpose: str) -> np.ndarray:
        """Tell for every ray whether anything is in its way: (N,) bool."""
        self._rays[purpose] += len(directions)
        return self._mesh.blocked(origins, directions)


class EmbreexMesh:
    """What `embree.EmbreeMesh` does, through the package embreex alone: slower, the same hits.

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


@dataclass
class RenderCost:
    """Cost of rendering: seconds by pass, rays by purpose."""

    #: Processor seconds by pass; other work on the machine does not count.
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    #: Rays by purpose.
    rays: Counter[str] = field(default_factory=Counter)

    @contextmanager
    def time(self, name: str) -> Iterator[None]:
        """Charge what happens inside to one pass."""
        start = time.process_time()
        yield
        self.seconds[name] += time.process_time() - start
