"""Ray casting against triangle meshes, through Embree, with its cost on record."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from hwp_bench.base.rays import ray_mesh

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
        self._mesh = ray_mesh(vertices, faces)
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
