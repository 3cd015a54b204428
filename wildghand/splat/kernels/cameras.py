"""The numbers of a camera that the projection reads, and its two maps."""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

from wildghand.splat import conventions as rules
from wildghand.splat.kernels.jit import inline, kernel

#: Numbers of a camera: rotation row by row, translation, fx, fy, cx, cy, and the range of the
#: tangents of view angles within which the perspective's Jacobian is followed, x then y.
CAMERA = 20
ROTATION, TRANSLATION, FOCAL, CENTER, TANGENTS = 0, 9, 12, 14, 16

_MARGIN = rules.FRUSTUM_MARGIN


@kernel
def prepare_cameras(viewmats, Ks, width, height, rows):
    """Writes the numbers of each camera; those of one that is not usable make it see nothing.

    Args:
        viewmats: float64 (I, 4, 4), world to camera.
        Ks: float64 (I, 3, 3), px.
        width, height: of the images, px.
        rows: out, float64 (I, CAMERA).
    """
    for i in range(len(rows)):
        row = rows[i]
        usable = Ks[i, 0, 0] > 0.0 and Ks[i, 1, 1] > 0.0
        for j in range(3):
            for k in range(3):
                row[ROTATION + 3 * j + k] = viewmats[i, j, k]
            row[TRANSLATION + j] = viewmats[i, j, 3]
        for j in range(2):
            row[FOCAL + j] = Ks[i, j, j]
            row[CENTER + j] = Ks[i, j, 2]
        for k in range(TANGENTS):
            usable = usable and math.isfinite(row[k])
        if not usable:
            row[:] = 0.0
            row[TRANSLATION + 2] = -1.0  # all that there is lies behind it
            row[FOCAL] = row[FOCAL + 1] = 1.0
        for j in range(2):
            size = height if j else width
            row[TANGENTS + 2 * j] = -(row[CENTER + j] + _MARGIN * size) / row[FOCAL + j]
            row[TANGENTS + 2 * j + 1] = (size - row[CENTER + j] + _MARGIN * size) / row[FOCAL + j]


@inline
def to_camera(camera, row, x, y, z):
    """One coordinate in camera axes; `row` 0, 1 or 2."""
    turned = x * camera[3 * row] + y * camera[3 * row + 1] + z * camera[3 * row + 2]
    return turned + camera[9 + row]


@inline
def jacobian_row(camera, axis, scale, tangent):
    """One row of J R: the perspective's Jacobian times the camera's rotation."""
    first = 3 * axis
    return (
        scale * (camera[first] - tangent * camera[6]),
        scale * (camera[first + 1] - tangent * camera[7]),
        scale * (camera[first + 2] - tangent * camera[8]),
    )
