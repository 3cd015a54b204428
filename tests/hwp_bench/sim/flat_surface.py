"""Flat surfaces that face the camera, for the tests of the renderer."""

from __future__ import annotations

import numpy as np

from hwp_bench.sim.geometry.surface import Surface, plain


def facing_camera(vertices: np.ndarray, faces: np.ndarray) -> Surface:
    """A grey hand's surface of (V, 3) vertices and (F, 3) faces with normals to the camera."""
    return Surface(
        vertices=vertices,
        normals=np.tile([0.0, 0.0, -1.0], (len(vertices), 1)),
        faces=faces,
        corner_uv=np.zeros((len(faces), 3, 2)),
        material=np.zeros(len(faces), dtype=np.int64),
        materials=(plain((0.5, 0.5, 0.5)),),
        hand=np.ones(len(faces), dtype=bool),
        openness=np.ones(len(vertices)),
    )
