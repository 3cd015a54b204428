"""Gaussians on the image plane, eight at a time in float64.

float64 because a needle's projected covariance is nearly singular, and because a pixel
coordinate in float32 is off by up to 3e-5 px, which an image error of 1e-5 does not allow.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from wildghand.splat import conventions as rules
from wildghand.splat.kernels import geometry as at
from wildghand.splat.kernels.jit import inline, kernel
from wildghand.splat.kernels.jobs import next_job
from wildghand.splat.kernels.lanes import select, split_exponent, square_root
from wildghand.splat.kernels.rows import (
    GROUP,
    ceil,
    fill_exact,
    floor,
    load1,
    load3,
    load4,
    round32,
    store_column,
    store_pairs,
    store_rows,
)
from wildghand.splat.kernels.tiles import TILE_HEIGHT

#: Gaussians in a piece of work; sums over Gaussians are made piece by piece, in order.
PIECE = 512
#: exponent -1/2 d^2 in base 2.
_HALF_LOG2E = 0.5 * math.log2(math.e)
_LOG2_255 = math.log2(255.0)
_SQUARED_REACH = 2.0 * math.log(2.0)
_TWO_OVER_LN2 = 2.0 / math.log(2.0)
_MAX_REACH = rules.MAX_REACH
_MAX_ALONG = math.sqrt(rules.MAX_PRECISION * _HALF_LOG2E)
_MIN_ALPHA = rules.MIN_ALPHA
_MAX_COLOR = np.float32(rules.MAX_COLOR)
_MAX_OPACITY = 3.5e38
_MAX_RADIUS = 2.0**30


@inline
def log2(x):
    """Base-2 logarithm in every lane, to 1e-12; x positive."""
    mantissa, exponent = split_exponent(x)
    t = (mantissa - 1.0) / (mantissa + 1.0)
    s = t * t
    series = s * (1.0 / 15.0) + 1.0 / 13.0
    series = s * series + 1.0 / 11.0
    series = s * series + 1.0 / 9.0
    series = s * series + 1.0 / 7.0
    series = s * series + 1.0 / 5.0
    series = s * series + 1.0 / 3.0
    series = s * series + 1.0
    return exponent + t * series * _TWO_OVER_LN2


@inline
def to_camera(camera, row, x, y, z):
    """One coordinate in camera axes; `row` 0, 1 or 2."""
    turned = x * camera[3 * row] + y * camera[3 * row + 1] + z * camera[3 * row + 2]
    return turned + camera[9 + row]


@inline
def rotation(w, x, y, z):
    """Rotation matrix of a unit quaternion, row by row."""
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz, wx, wy, wz = x * y, x * z, y * z, w * x, w * y, w * z
    one = fill_exact(1.0)
    return (
        (one - (yy + zz) * 2.0, (xy - wz) * 2.0, (xz + wy) * 2.0),
        ((xy + wz) * 2.0, one - (xx + zz) * 2.0, (yz - wx) * 2.0),
        ((xz - wy) * 2.0, (yz + wx) * 2.0, one - (xx + yy) * 2.0),
    )


@inline
def clamp(x, low, high):
    """x brought into [low, high]."""
    x = select(x < low, low, x)
    return select(x > high, high, x)


@inline
def jacobian_row(camera, axis, scale, tangent):
    """One row of J R: the perspective's Jacobian times the camera's rotation."""
    first = 3 * axis
    return (
        scale * (camera[first] - tangent * camera[6]),
        scale * (camera[first + 1] - tangent * camera[7]),
        scale * (camera[first + 2] - tangent * camera[8]),
    )


@inline
def times(row, matrix):
    """Row vector times 3 x 3 matrix."""
    a, b, c = row
    m0, m1, m2 = matrix
    return (
        a * m0[0] + b * m1[0] + c * m2[0],
        a * m0[1] + b * m1[1] + c * m2[1],
        a * m0[2] + b * m1[2] + c * m2[2],
    )


@inline
def dot(a, b):
    """Inner product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline
def cross(a, b):
    """Vector product of two triples."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@inline
def scaled(row, scale):
    """Triple times triple, one by one."""
    return (row[0] * scale[0], row[1] * scale[1], row[2] * scale[2])


@inline
def project_group(
    means, mean, quats, quat, scales, scale, opacities, opacity, usable,
    camera, width, height, near, far, eps2d, antialiased,
    geom, row, depths, rows, radii, compensations, to,
):  # fmt: skip
    """Projects 8 Gaussians that start at the given flat indices."""
    mx, my, mz = load3(means, mean)
    qw, qx, qy, qz = load4(quats, quat)
    (alpha,) = load1(opacities, opacity)
    (may,) = load1(usable, 0)
    x = to_camera(camera, 0, mx, my, mz)
    y = to_camera(camera, 1, mx, my, mz)
    z = to_camera(camera, 2, mx, my, mz)
    seen = (z > near) & (z < far) & (may > 0.0)
    z = select(seen, z, 1.0)
    norm = qw * qw + qx * qx + qy * qy + qz * qz
    seen = seen & (norm > 0.0)
    over = 1.0 / square_root(norm)
    turn = rotation(qw * over, qx * over, qy * over, qz * over)
    inverse = 1.0 / z
    tan_x = x * inverse
    tan_y = y * inverse
    fx, fy = camera[12], camera[13]
    along_x = jacobian_row(camera, 0, inverse * fx, clamp(tan_x, camera[16], camera[17]))
    along_y = jacobian_row(camera, 1, inverse * fy, clamp(tan_y, camera[18], camera[19]))
    size = load3(scales, scale)
    u = scaled(times(along_x, turn), size)
    v = scaled(times(along_y, turn), size)
    normal = cross(u, v)
    area = dot(normal, normal)
    trace_x, trace_y = dot(u, u), dot(v, v)
    A, B, C = trace_x + eps2d, dot(u, v), trace_y + eps2d
    det = area + (trace_x + trace_y) * eps2d + eps2d * eps2d
    if antialiased:
        ratio = square_root(area / det)
        alpha = alpha * ratio
        store_column(compensations, to, select(ratio > 0.0, ratio, 0.0))
    seen = seen & (det > 0.0) & (alpha >= _MIN_ALPHA) & (alpha < _MAX_OPACITY)
    alpha = select(seen, alpha, 1.0)
    log_alpha = log2(alpha)
    reach = (log_alpha + _LOG2_255) * _SQUARED_REACH
    reach_x = square_root(reach * A)
    reach_y = square_root(reach * C)
    px = tan_x * fx + camera[14]
    py = tan_y * fy + camera[15]
    along = square_root(C / det * _HALF_LOG2E)
    across = square_root(_HALF_LOG2E / C)
    seen = seen & (reach_x < _MAX_REACH) & (reach_y < _MAX_REACH) & (along < _MAX_ALONG)
    seen = seen & (px + reach_x >= 0.5) & (px - reach_x <= width - 0.5)
    seen = seen & (py + reach_y >= 0.5) & (py - reach_y <= height - 0.5)
    first = floor(clamp(py - reach_y - 0.5, 0.0, height - 1.0) * (1.0 / TILE_HEIGHT))
    last = floor(clamp(py + reach_y - 0.5, 0.0, height - 1.0) * (1.0 / TILE_HEIGHT))
    shear = 0.0 - B / C
    px_high, py_high, shear_high = round32(px), round32(py), round32(shear)
    zero = fill_exact(0.0)
    store_rows(
        geom,
        row,
        (
            select(seen, px_high, zero),
            select(seen, py_high, zero),
            select(seen, px - px_high, zero),
            select(seen, py - py_high, zero),
            select(seen, shear_high, zero),
            select(seen, shear - shear_high, zero),
            select(seen, along, zero),
            select(seen, across, zero),
            select(seen, log_alpha, zero),
            select(seen, reach_x, zero),
            select(seen, reach_y, zero),
            select(seen, reach_x * (B / A), zero),
            select(seen, first, zero),
            select(seen, last - first + 1.0, zero),
            zero,
            zero,
        ),
    )
    store_column(depths, to, select(seen, z, 0.0))
    store_column(rows, to, select(seen, last - first + 1.0, 0.0))
    store_pairs(
        radii,
        2 * to,
        select(seen, clamp(ceil(reach_x), 0.0, _MAX_RADIUS), 0.0),
        select(seen, clamp(ceil(reach_y), 0.0, _MAX_RADIUS), 0.0),
    )


@inline
def mark_usable(colors, first, channels, usable):
    """Writes 1 for each of 8 Gaussians whose colour is within bounds, else 0."""
    for lane in range(GROUP):
        bad = False
        for k in range(channels):
            bad |= not (abs(colors[first + lane * channels + k]) <= _MAX_COLOR)
        usable[lane] = np.float32(0.0) if bad else np.float32(1.0)


@kernel
def project(
    worker, counters, ends,
    means, quats, scales, opacities, colors, channels, repeats, cameras, gaussians,
    width, height, near, far, eps2d, antialiased, geom, depths, rows, radii,
    compensations,
):  # fmt: skip
    """Projects every Gaussian of every image; at least 8 Gaussians.

    Args:
        worker, counters, ends: see `next_job`; a job is a piece of an image.
        means, quats, scales, opacities, colors: flat float32, (S, N, k).
        channels: floats in a colour.
        repeats: int64 (5,); image i reads entry i // repeats[k] of the S of each of the five.
        cameras: float64 (I, CAMERA), see `cameras`.
        gaussians: N.
        geom: out, flat float32 (I, N, 16), see `geometry`.
        depths: out, flat float32 (I, N); 0 where culled.
        rows: out, flat int32 (I, N); rows of tiles that the splat touches.
        radii: out, flat int32 (I, N, 2); half the size of the visible part in whole pixels.
        compensations: out, flat float32 (I, N), only if `antialiased`.
    """
    pieces = max(1, gaussians // PIECE)
    usable = np.empty(GROUP, np.float32)
    while True:
        job = next_job(worker, counters, ends)
        if job < 0:
            break
        image = job // pieces
        piece = job - image * pieces
        stop = (piece + 1) * gaussians // pieces
        for start in range(piece * gaussians // pieces, stop, GROUP):
            n = min(start, stop - GROUP)
            mark_usable(colors, (image // repeats[4] * gaussians + n) * channels, channels, usable)
            to = image * gaussians + n
            project_group(
                means, (image // repeats[0] * gaussians + n) * 3,
                quats, (image // repeats[1] * gaussians + n) * 4,
                scales, (image // repeats[2] * gaussians + n) * 3,
                opacities, image // repeats[3] * gaussians + n,
                usable, cameras[image], width, height, near, far, eps2d, antialiased,
                geom, to * at.ROW, depths, rows, radii, compensations, to,
            )  # fmt: skip
