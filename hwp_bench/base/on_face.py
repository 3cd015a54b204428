"""Where rays meet the faces that Embree names, by rules that hold on every processor.

Embree's own distance and place on a face come from approximate reciprocals, whose last bits differ
between processors: captures that were rendered on an Intel and an AMD processor had other digests,
though of 100,000 values no more than one differed (`docs/simulation.md`).
"""

from __future__ import annotations

import numpy as np

from hwp_bench.base.compiled import compiled
from hwp_bench.base.vectors import cross, dot

#: (u, v, distance), each (H,) float32: the place is (1 - u - v) a + u b + v c of the corners.
Places = tuple[np.ndarray, np.ndarray, np.ndarray]


@compiled(nogil=True)
def places_on_faces(
    vertices: np.ndarray,
    faces: np.ndarray,
    origins: np.ndarray,
    directions: np.ndarray,
    ray: np.ndarray,
    face: np.ndarray,
) -> Places:
    """Where each ray meets its face, in double precision; no place is outside the face.

    Source: Möller and Trumbore, Fast, Minimum Storage Ray/Triangle Intersection (1997). Rays and
    vertices are rounded to single precision first, as Embree has them. A ray within the plane of
    its face meets it at the first corner.

    Args:
        vertices: (V, 3) float32 m.
        faces: (F, 3) vertex indices.
        origins: (N, 3) m, or (1, 3) for all.
        directions: (N, 3), any length; distances count in it.
        ray: (H,) which ray met something.
        face: (H,) the face that it met.
    """
    count = len(ray)
    u, v = np.empty(count, np.float32), np.empty(count, np.float32)
    distance = np.empty(count, np.float32)
    several = len(origins) > 1
    first, second, across, over = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    start, along = np.empty(3), np.empty(3)
    for i in range(count):
        a, b, c = faces[face[i], 0], faces[face[i], 1], faces[face[i], 2]
        origin = ray[i] if several else 0
        for k in range(3):
            corner = np.float64(vertices[a, k])
            first[k] = np.float64(vertices[b, k]) - corner
            second[k] = np.float64(vertices[c, k]) - corner
            start[k] = np.float64(np.float32(origins[origin, k])) - corner
            along[k] = np.float64(np.float32(directions[ray[i], k]))
        cross(along, second, across)
        cross(start, first, over)
        determinant = dot(first, across)
        s = t = 0.0
        if determinant != 0.0:
            s = max(dot(start, across) / determinant, 0.0)
            t = max(dot(along, over) / determinant, 0.0)
            outside = max(s + t, 1.0)
            s, t = s / outside, t / outside
        for k in range(3):
            start[k] = s * first[k] + t * second[k] - start[k]
        u[i], v[i], distance[i] = s, t, dot(start, along) / dot(along, along)
    return u, v, distance
