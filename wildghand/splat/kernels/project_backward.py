"""Gradients through the projection: from the image plane to the Gaussians and the cameras."""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wildghand.splat.kernels.algebra import by, cross, dot, keep, plus, rotation, scaled
from wildghand.splat.kernels.cameras import to_camera
from wildghand.splat.kernels.jit import inline, kernel
from wildghand.splat.kernels.jobs import next_job
from wildghand.splat.kernels.lanes import select, square_root
from wildghand.splat.kernels.project import PIECE, entry_of, flatten
from wildghand.splat.kernels.rows import (
    GROUP,
    add_columns,
    fill_exact,
    lane_index,
    load1,
    load2,
    load3,
    load4,
    total,
)


class PlaneGradients(NamedTuple):
    """Gradients of the loss by the projected Gaussians."""

    means2d: np.ndarray  # (I, N, 2) float32
    shapes: np.ndarray  # (I, N, 3) float32, see `reduce`
    depths: np.ndarray  # (I, N) float32, or (0, 0) if depth has no gradient
    compensations: np.ndarray  # (I, N) float32, read only if antialiased


@kernel
def project_backward(
    worker, counters, ends, ellipsoids, cameras, depths, view, upstream, gradients, v_cameras
):
    """Gradients of the Gaussians and the cameras.

    Args:
        worker, counters, ends: see `next_job`; a job is a piece of Gaussians.
        ellipsoids, cameras, view: as for `project`.
        depths: float32 (I, N); 0 where culled.
        upstream: `PlaneGradients`.
        gradients: out, `Ellipsoids`.
        v_cameras: out, float64 (I, pieces, 12); rotation row by row, then translation, one sum
            for each piece of Gaussians. (I, 0, 12) if it is not needed.
    """
    images, gaussians = depths.shape
    pieces = max(1, gaussians // PIECE)
    with_cameras = v_cameras.shape[1] > 0
    zero = fill_exact(0.0)
    nothing = (zero, zero, zero)
    while True:
        piece = next_job(worker, counters, ends)
        if piece < 0:
            break
        begin, stop = piece * gaussians // pieces, (piece + 1) * gaussians // pieces
        for i in range(images):
            camera = cameras[i]
            clear_first(gradients.means, i, images, begin, stop)
            clear_first(gradients.quats, i, images, begin, stop)
            clear_first(gradients.scales, i, images, begin, stop)
            of_means = entry_of(ellipsoids.means, i, images) * gaussians
            of_quats = entry_of(ellipsoids.quats, i, images) * gaussians
            of_scales = entry_of(ellipsoids.scales, i, images) * gaussians
            sums = (nothing, nothing, nothing, nothing)
            for start in range(begin, stop, GROUP):
                first = min(start, stop - GROUP)
                (depth,) = load1(depths, i * gaussians + first)
                # The last group of a piece reaches back; those that it repeats count once.
                seen = (depth > 0.0) & (lane_index() >= np.float64(start - first))
                mean = load3(ellipsoids.means, (of_means + first) * 3)
                plane, moved, v_quat, v_size, v_t = group_backward(
                    seen,
                    mean,
                    load4(ellipsoids.quats, (of_quats + first) * 4),
                    load3(ellipsoids.scales, (of_scales + first) * 3),
                    camera, view, upstream, i * gaussians + first,
                )  # fmt: skip
                add_columns(gradients.means, (of_means + first) * 3, from_camera(camera, moved))
                add_columns(gradients.quats, (of_quats + first) * 4, v_quat)
                add_columns(gradients.scales, (of_scales + first) * 3, v_size)
                if with_cameras:
                    sums = add_camera(sums, seen, keep(seen, mean), moved, plane, camera, v_t)
            if with_cameras:
                place = v_cameras[i, piece]
                for row in range(4):
                    place[3 * row] = total(sums[row][0])
                    place[3 * row + 1] = total(sums[row][1])
                    place[3 * row + 2] = total(sums[row][2])


@inline
def group_backward(seen, mean, quat, size, camera, view, upstream, at):
    """Gradients of 8 Gaussians from those at the flat index `at`; zeros where not seen.

    Returns:
        `OnPlane`, and the gradients of the mean in camera axes, of the quaternion, of the size,
        and (also where not seen) of the two rows of J R.
    """
    x = to_camera(camera, 0, mean[0], mean[1], mean[2])
    y = to_camera(camera, 1, mean[0], mean[1], mean[2])
    z = select(seen, to_camera(camera, 2, mean[0], mean[1], mean[2]), 1.0)
    qw, qx, qy, qz = quat
    over = 1.0 / square_root(qw * qw + qx * qx + qy * qy + qz * qz)
    qw, qx, qy, qz = qw * over, qx * over, qy * over, qz * over
    turn = rotation(qw, qx, qy, qz)
    plane = flatten(camera, x, y, z, turn, size, view.eps2d)

    v_log_a, v_log_c, v_shear = load3(upstream.shapes, 3 * at)
    v_u, v_v = shape_gradient(plane, view.eps2d, v_log_a, v_log_c, v_shear)
    if view.antialiased:
        (v_ratio,) = load1(upstream.compensations, at)
        more_u, more_v = compensation_gradient(plane, view.eps2d, v_ratio)
        v_u, v_v = plus(v_u, more_u), plus(v_v, more_v)
    v_size = plus(scaled(v_u, plane.w[0]), scaled(v_v, plane.w[1]))
    v_wx, v_wy = scaled(v_u, size), scaled(v_v, size)
    v_turn = (
        plus(by(v_wx, plane.t[0][0]), by(v_wy, plane.t[1][0])),
        plus(by(v_wx, plane.t[0][1]), by(v_wy, plane.t[1][1])),
        plus(by(v_wx, plane.t[0][2]), by(v_wy, plane.t[1][2])),
    )
    g_w, g_x, g_y, g_z = quaternion_gradient((qw, qx, qy, qz), over, v_turn)
    v_tx = (dot(turn[0], v_wx), dot(turn[1], v_wx), dot(turn[2], v_wx))
    v_ty = (dot(turn[0], v_wy), dot(turn[1], v_wy), dot(turn[2], v_wy))

    v_px, v_py = load2(upstream.means2d, 2 * at)
    v_x, v_y, v_z = position_gradient(x, y, plane, camera, v_px, v_py, v_tx, v_ty)
    if upstream.depths.size > 0:
        (v_depth,) = load1(upstream.depths, at)
        v_z = v_z + v_depth
    zero = fill_exact(0.0)
    v_quat = (
        select(seen, g_w, zero),
        select(seen, g_x, zero),
        select(seen, g_y, zero),
        select(seen, g_z, zero),
    )
    return plane, keep(seen, (v_x, v_y, v_z)), v_quat, keep(seen, v_size), (v_tx, v_ty)


@inline
def shape_gradient(plane, eps2d, v_log_a, v_log_c, v_shear):
    """Gradient of the two rows of J R M from that of the Cholesky form of their Gram matrix.

    What is left of u after its part along v, u + shear v, is tiny compared to u for a needle; as a
    vector product with u x v it keeps its digits.
    """
    u, v, normal = plane.u, plane.v, plane.normal
    shear = 0.0 - plane.B / plane.C
    a = plane.C / plane.det
    c = 1.0 / plane.C
    g = a * v_log_a * (0.0 - 2.0)  # twice the gradient of 1 / a
    h = v_shear * square_root(a * c)
    rest = by(plus(cross(v, normal), by(u, fill_exact(eps2d))), c)
    v_u = plus(by(rest, g), by(v, 0.0 - h))
    tilted = plus(rest, by(v, shear))
    v_v = plus(by(rest, shear * g), plus(by(tilted, 0.0 - h), by(v, c * v_log_c * (0.0 - 2.0))))
    return v_u, v_v


@inline
def compensation_gradient(plane, eps2d, v_ratio):
    """Gradient of the two rows from that of sqrt(area / det)."""
    u, v, normal, area, det = plane.u, plane.v, plane.normal, plane.area, plane.det
    ratio = square_root(area / det)
    half = v_ratio * ratio
    of_area = select(area > 0.0, half / area, 0.0) - half / det
    of_trace = half * (0.0 - eps2d) / det
    v_u = plus(by(cross(v, normal), of_area), by(u, of_trace))
    v_v = plus(by(cross(normal, u), of_area), by(v, of_trace))
    return v_u, v_v


@inline
def quaternion_gradient(quat, over, n):
    """Gradient of a quaternion of norm 1 / over, `quat` times it, from that of its matrix."""
    w, x, y, z = quat
    n0, n1, n2 = n
    g_w = (x * (n2[1] - n1[2]) + y * (n0[2] - n2[0]) + z * (n1[0] - n0[1])) * 2.0
    g_x = (y * (n1[0] + n0[1]) + z * (n2[0] + n0[2]) + w * (n2[1] - n1[2])) * 2.0
    g_x = g_x - x * (n1[1] + n2[2]) * 4.0
    g_y = (x * (n1[0] + n0[1]) + z * (n2[1] + n1[2]) + w * (n0[2] - n2[0])) * 2.0
    g_y = g_y - y * (n0[0] + n2[2]) * 4.0
    g_z = (x * (n2[0] + n0[2]) + y * (n2[1] + n1[2]) + w * (n1[0] - n0[1])) * 2.0
    g_z = g_z - z * (n0[0] + n1[1]) * 4.0
    radial = g_w * w + g_x * x + g_y * y + g_z * z
    return (
        (g_w - radial * w) * over,
        (g_x - radial * x) * over,
        (g_y - radial * y) * over,
        (g_z - radial * z) * over,
    )


@inline
def position_gradient(x, y, plane, camera, v_px, v_py, v_tx, v_ty):
    """Gradient of a mean in camera axes from those of its pixel and of the rows of J R."""
    fx, fy = camera[12], camera[13]
    inverse = plane.inverse
    scale_x, scale_y = inverse * fx, inverse * fy
    v_scale_x = dot(v_tx, plane.t[0]) / scale_x
    v_scale_y = dot(v_ty, plane.t[1]) / scale_y
    along_x = v_tx[0] * camera[6] + v_tx[1] * camera[7] + v_tx[2] * camera[8]
    along_y = v_ty[0] * camera[6] + v_ty[1] * camera[7] + v_ty[2] * camera[8]
    tan_x, tan_y = plane.tangent
    free_x = (tan_x >= camera[16]) & (tan_x <= camera[17])
    free_y = (tan_y >= camera[18]) & (tan_y <= camera[19])
    zero = fill_exact(0.0)
    v_tan_x = v_px * fx - select(free_x, scale_x * along_x, zero)
    v_tan_y = v_py * fy - select(free_y, scale_y * along_y, zero)
    v_inverse = v_scale_x * fx + v_scale_y * fy + v_tan_x * x + v_tan_y * y
    return v_tan_x * inverse, v_tan_y * inverse, zero - v_inverse * inverse * inverse


@inline
def from_camera(camera, moved):
    """Gradient of a mean in the world from that in camera axes."""
    v_x, v_y, v_z = moved
    return (
        v_x * camera[0] + v_y * camera[3] + v_z * camera[6],
        v_x * camera[1] + v_y * camera[4] + v_z * camera[7],
        v_x * camera[2] + v_y * camera[5] + v_z * camera[8],
    )


@inline
def add_camera(sums, seen, mean, moved, plane, camera, v_t):
    """Adds the gradients of the camera's rotation, row by row, and of its translation.

    J R depends on R through its own row and, by the tangent, the third.
    """
    zero = fill_exact(0.0)
    v_x, v_y, v_z = moved
    of_x = keep(seen, by(v_t[0], plane.inverse * camera[12]))
    of_y = keep(seen, by(v_t[1], plane.inverse * camera[13]))
    held = plus(
        by(of_x, select(seen, plane.held[0], zero)), by(of_y, select(seen, plane.held[1], zero))
    )
    return (
        plus(sums[0], plus(by(mean, v_x), of_x)),
        plus(sums[1], plus(by(mean, v_y), of_y)),
        plus(sums[2], plus(by(mean, v_z), by(held, fill_exact(-1.0)))),
        plus(sums[3], moved),
    )


@inline
def clear_first(gradient, image, images, begin, stop):
    """Zeros for Gaussians `begin` to `stop`, by the first image of those that share them."""
    if image % (images // max(1, len(gradient))) == 0:
        gradient[entry_of(gradient, image, images), begin:stop] = 0.0
