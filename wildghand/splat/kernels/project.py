"""Gaussians on the image plane, eight at a time in float64.

float64 because a needle's projected covariance is nearly singular, and because a pixel
coordinate in float32 is off by up to 3e-5 px, which an image error of 1e-5 does not allow.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from wildghand.splat import conventions as rules
from wildghand.splat.kernels import geometry as at
from wildghand.splat.kernels.algebra import clamp, cross, dot, log2, rotation, scaled, times
from wildghand.splat.kernels.cameras import jacobian_row, to_camera
from wildghand.splat.kernels.jit import inline, kernel
from wildghand.splat.kernels.jobs import next_job
from wildghand.splat.kernels.lanes import select, square_root
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
_MAX_REACH = rules.MAX_REACH
_MAX_ALONG = math.sqrt(rules.MAX_PRECISION * _HALF_LOG2E)
_MIN_ALPHA = rules.MIN_ALPHA
_MAX_COLOR = np.float32(rules.MAX_COLOR)
_MAX_OPACITY = 3.5e38
_MAX_RADIUS = 2.0**30


class Ellipsoids(NamedTuple):
    """Place, rotation and size of S x N Gaussians, or their gradients; N at least `GROUP`.

    Image i of I reads entry i // (I // S), for each of the three its own S.
    """

    means: np.ndarray  # (S, N, 3) float32
    quats: np.ndarray  # (S, N, 4) float32
    scales: np.ndarray  # (S, N, 3) float32


class View(NamedTuple):
    """The numbers of `scene.Options` that the projection reads."""

    width: float  # px
    height: float  # px
    near: float
    far: float
    eps2d: float  # px^2
    antialiased: bool


class Projected(NamedTuple):
    """The Gaussians on the image planes."""

    geom: np.ndarray  # (I, N, 16) float32, see `geometry`
    depths: np.ndarray  # (I, N) float32, 0 where culled
    rows: np.ndarray  # (I, N) int32, rows of tiles that the splat touches
    radii: np.ndarray  # (I, N, 2) int32, half the size of the visible part in pixels
    compensations: np.ndarray  # (I, N) float32, or (I, 0) if not antialiased


class OnPlane(NamedTuple):
    """Eight Gaussians as the perspective, made linear at their centres, flattens them.

    With J the Jacobian of the perspective, R the camera's rotation, and M the Gaussian's rotation
    times its sizes, the covariance on the image plane is J R M (J R M)^T + eps2d = (A B; B C).
    """

    inverse: Any  # 1 / z
    tangent: tuple[Any, Any]  # x / z and y / z
    held: tuple[Any, Any]  # the same within the range where J is followed
    t: tuple[Any, Any]  # rows of J R
    w: tuple[Any, Any]  # rows of J R times the Gaussian's rotation
    u: tuple[Any, Any, Any]  # first row of J R M
    v: tuple[Any, Any, Any]  # second row
    normal: tuple[Any, Any, Any]  # u x v, which keeps its digits for needles
    area: Any  # its squared length: the determinant without eps2d
    A: Any
    B: Any
    C: Any
    det: Any


@inline
def entry_of(shared, image, images):
    """Which entry of a shared array an image reads."""
    return image // (images // max(1, len(shared)))


@inline
def flatten(camera, x, y, z, turn, size, eps2d):
    """`OnPlane` of Gaussians at x, y, z in camera axes."""
    inverse = 1.0 / z
    tan_x = x * inverse
    tan_y = y * inverse
    held_x = clamp(tan_x, camera[16], camera[17])
    held_y = clamp(tan_y, camera[18], camera[19])
    t_x = jacobian_row(camera, 0, inverse * camera[12], held_x)
    t_y = jacobian_row(camera, 1, inverse * camera[13], held_y)
    w_x, w_y = times(t_x, turn), times(t_y, turn)
    u, v = scaled(w_x, size), scaled(w_y, size)
    normal = cross(u, v)
    area = dot(normal, normal)
    trace_x, trace_y = dot(u, u), dot(v, v)
    det = area + (trace_x + trace_y) * eps2d + eps2d * eps2d
    return OnPlane(
        inverse, (tan_x, tan_y), (held_x, held_y), (t_x, t_y), (w_x, w_y), u, v, normal, area,
        trace_x + eps2d, dot(u, v), trace_y + eps2d, det,
    )  # fmt: skip


@inline
def project_group(mean, quat, size, alpha, usable, camera, view, projected, to):
    """Projects 8 Gaussians and writes them to the flat index `to` of `projected`."""
    x = to_camera(camera, 0, mean[0], mean[1], mean[2])
    y = to_camera(camera, 1, mean[0], mean[1], mean[2])
    z = to_camera(camera, 2, mean[0], mean[1], mean[2])
    seen = (z > view.near) & (z < view.far) & (usable > 0.0)
    z = select(seen, z, 1.0)
    qw, qx, qy, qz = quat
    norm = qw * qw + qx * qx + qy * qy + qz * qz
    seen = seen & (norm > 0.0)
    over = 1.0 / square_root(norm)
    turn = rotation(qw * over, qx * over, qy * over, qz * over)
    plane = flatten(camera, x, y, z, turn, size, view.eps2d)
    if view.antialiased:
        ratio = square_root(plane.area / plane.det)
        alpha = alpha * ratio
        store_column(projected.compensations, to, select(ratio > 0.0, ratio, 0.0))
    seen = seen & (plane.det > 0.0) & (alpha >= _MIN_ALPHA) & (alpha < _MAX_OPACITY)
    log_alpha = log2(select(seen, alpha, 1.0))
    store_visible(seen, z, log_alpha, plane, camera, view, projected, to)


@inline
def store_visible(seen, z, log_alpha, plane, camera, view, projected, to):
    """Culls Gaussians off screen, too large or too thin; writes the others, and zeros if culled."""
    A, B, C = plane.A, plane.B, plane.C
    reach = (log_alpha + _LOG2_255) * _SQUARED_REACH
    reach_x = square_root(reach * A)
    reach_y = square_root(reach * C)
    px = plane.tangent[0] * camera[12] + camera[14]
    py = plane.tangent[1] * camera[13] + camera[15]
    along = square_root(C / plane.det * _HALF_LOG2E)
    across = square_root(_HALF_LOG2E / C)
    seen = seen & (reach_x < _MAX_REACH) & (reach_y < _MAX_REACH) & (along < _MAX_ALONG)
    seen = seen & (px + reach_x >= 0.5) & (px - reach_x <= view.width - 0.5)
    seen = seen & (py + reach_y >= 0.5) & (py - reach_y <= view.height - 0.5)
    first = floor(clamp(py - reach_y - 0.5, 0.0, view.height - 1.0) * (1.0 / TILE_HEIGHT))
    last = floor(clamp(py + reach_y - 0.5, 0.0, view.height - 1.0) * (1.0 / TILE_HEIGHT))
    shear = 0.0 - B / C
    px_high, py_high, shear_high = round32(px), round32(py), round32(shear)
    zero = fill_exact(0.0)
    store_rows(
        projected.geom,
        to * at.ROW,
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
    store_column(projected.depths, to, select(seen, z, 0.0))
    store_column(projected.rows, to, select(seen, last - first + 1.0, 0.0))
    store_pairs(
        projected.radii,
        2 * to,
        select(seen, clamp(ceil(reach_x), 0.0, _MAX_RADIUS), 0.0),
        select(seen, clamp(ceil(reach_y), 0.0, _MAX_RADIUS), 0.0),
    )


@inline
def mark_usable(colors, entry, first, usable):
    """Writes 1 for each of 8 Gaussians whose colour is within bounds, else 0."""
    for lane in range(GROUP):
        bad = False
        for k in range(colors.shape[2]):
            bad |= not (abs(colors[entry, first + lane, k]) <= _MAX_COLOR)
        usable[lane] = np.float32(0.0) if bad else np.float32(1.0)


@kernel
def project(worker, counters, ends, ellipsoids, opacities, colors, cameras, view, projected):
    """Projects every Gaussian of every image.

    Args:
        worker, counters, ends: see `next_job`; a job is a piece of an image.
        ellipsoids: `Ellipsoids`.
        opacities: float32 (S, N).
        colors: float32 (S, N, D), to see which are finite.
        cameras: float64 (I, CAMERA), see `cameras`.
        view: `View`.
        projected: out, `Projected`; compensations only if antialiased.
    """
    images, gaussians = projected.depths.shape
    means, quats, scales = ellipsoids
    pieces = max(1, gaussians // PIECE)
    usable = np.empty(GROUP, np.float32)
    while True:
        job = next_job(worker, counters, ends)
        if job < 0:
            break
        image = job // pieces
        piece = job - image * pieces
        camera = cameras[image]
        of_means = entry_of(means, image, images) * gaussians
        of_quats = entry_of(quats, image, images) * gaussians
        of_scales = entry_of(scales, image, images) * gaussians
        of_opacities = entry_of(opacities, image, images) * gaussians
        of_colors = entry_of(colors, image, images)
        stop = (piece + 1) * gaussians // pieces
        for start in range(piece * gaussians // pieces, stop, GROUP):
            n = min(start, stop - GROUP)
            mark_usable(colors, of_colors, n, usable)
            (may,) = load1(usable, 0)
            (alpha,) = load1(opacities, of_opacities + n)
            project_group(
                load3(means, (of_means + n) * 3),
                load4(quats, (of_quats + n) * 4),
                load3(scales, (of_scales + n) * 3),
                alpha, may, camera, view, projected, image * gaussians + n,
            )  # fmt: skip
