"""What leads away from the wrist, sleeve or arm: rings of vertices joined to one surface."""

from __future__ import annotations

import numpy as np

from hwp_bench.sim.geometry.mesh import normal_operator, surface_normals
from hwp_bench.sim.geometry.surface import Material, Surface


def ringed(
    vertices: np.ndarray,
    around: tuple[np.ndarray, np.ndarray],
    along: np.ndarray,
    material: Material,
) -> Surface:
    """Join rings behind one another to a surface that looks outward and is not a hand.

    Args:
        vertices: (R * K, 3) m, R rings of K vertices each.
        around: (K,) texture coordinate of each vertex of a ring, and (K,) of the one after it: at
            the seam the two differ by a whole turn.
        along: (R,) texture coordinate of each ring.
        material: what all of it is made of.
    """
    count, spokes = len(along), len(around[0])
    ring, spoke = np.meshgrid(np.arange(count - 1), np.arange(spokes), indexing="ij")
    a = (ring * spokes + spoke).ravel()
    b = (ring * spokes + (spoke + 1) % spokes).ravel()
    c, d = a + spokes, b + spokes
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    left, right = (side[spoke.ravel()] for side in around)
    near, far = (along[ring.ravel() + step] for step in (0, 1))
    uv_a, uv_b = np.stack([left, near], 1), np.stack([right, near], 1)
    uv_c, uv_d = np.stack([left, far], 1), np.stack([right, far], 1)
    corner_uv = np.concatenate([np.stack([uv_a, uv_c, uv_b], 1), np.stack([uv_b, uv_c, uv_d], 1)])
    normals = surface_normals(vertices, faces, normal_operator(faces, len(vertices)))
    middles = vertices.reshape(count, spokes, 3).mean(axis=1)
    outward = vertices - np.repeat(middles, spokes, axis=0)
    if np.einsum("ni,ni->n", normals, outward).sum() < 0:
        faces, corner_uv, normals = faces[:, ::-1], corner_uv[:, ::-1], -normals
    return Surface(
        vertices=vertices,
        normals=normals,
        faces=np.ascontiguousarray(faces),
        corner_uv=np.ascontiguousarray(corner_uv),
        material=np.zeros(len(faces), dtype=np.int64),
        materials=(material,),
        hand=np.zeros(len(faces), dtype=bool),
    )
