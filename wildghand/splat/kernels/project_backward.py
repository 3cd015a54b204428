"""Gradients through the projection: from the image plane to the Gaussians and the cameras."""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from wildghand.splat.kernels.jit import inline, kernel
from wildghand.splat.kernels.jobs import next_job
from wildghand.splat.kernels.lanes import select, square_root
from wildghand.splat.kernels.project import (
    PIECE,
    clamp,
    cross,
    dot,
    jacobian_row,
    rotation,
    scaled,
    times,
    to_camera,
)
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


@inline
def plus(a, b):
    """Sum of two triples."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@inline
def by(a, number):
    """Triple times one number."""
    return (a[0] * number, a[1] * number, a[2] * number)


@inline
def keep(mask, values):
    """A triple where the mask holds, else zeros, even where it is NaN."""
    zero = fill_exact(0.0)
    return (
        select(mask, values[0], zero),
        select(mask, values[1], zero),
        select(mask, values[2], zero),
    )


@inline
def clear_first(gradient, size, image, repeat, gaussians, begin, stop):
    """Zeros for Gaussians `begin` to `stop`, by the first image of those that share them."""
    if image % repeat == 0:
        base = image // repeat * gaussians
        gradient[(base + begin) * size : (base + stop) * size] = 0.0


@inline
def shape_gradient(u, v, normal, C, det, shear, eps2d, v_log_a, v_log_c, v_shear):
    """Gradient of the two rows of J R M from that of the Cholesky form of their Gram matrix.

    `normal` is u x v. What is left of u after its part along v, u + shear v, is tiny beside u for
    a needle; as a vector product it keeps its digits.
    """
    a = C / det
    c = 1.0 / C
    g = a * v_log_a * (0.0 - 2.0)  # twice the gradient of 1 / a
    h = v_shear * square_root(a * c)
    rest = by(plus(cross(v, normal), by(u, fill_exact(eps2d))), c)
    v_u = plus(by(rest, g), by(v, 0.0 - h))
    tilted = plus(rest, by(v, shear))
    v_v = plus(by(rest, shear * g), plus(by(tilted, 0.0 - h), by(v, c * v_log_c * (0.0 - 2.0))))
    return v_u, v_v


@inline
def compensation_gradient(u, v, normal, area, det, eps2d, v_ratio):
    """Gradient of the two rows from that of sqrt(area / det)."""
    ratio = square_root(area / det)
    half = v_ratio * ratio
    of_area = select(area > 0.0, half / area, 0.0) - half / det
    of_trace = half * (0.0 - eps2d) / det
    v_u = plus(by(cross(v, normal), of_area), by(u, of_trace))
    v_v = plus(by(cross(normal, u), of_area), by(v, of_trace))
    return v_u, v_v


@inline
def quaternion_gradient(w, x, y, z, over, n):
    """Gradient of a quaternion of any norm from that of its rotation matrix."""
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


@kernel
def project_backward(
    worker, counters, ends,
    means, quats, scales, repeats, cameras, gaussians, depths, eps2d,
    v_means2d, v_shapes, v_depths, v_compensations, antialiased, want_cameras,
    v_means, v_quats, v_scales, v_cameras,
):  # fmt: skip
    """Gradients of the Gaussians and the cameras; at least 8 Gaussians.

    Args:
        worker, counters, ends: see `next_job`; a job is a piece of Gaussians.
        means, quats, scales: flat float32 (S, N, k), as in `project`.
        repeats: int64 (3 or more,); image i reads entry i // repeats[k] of the S.
        cameras: float64 (I, CAMERA), see `cameras`.
        gaussians: N.
        depths: float32 (I, N); 0 where culled.
        v_means2d, v_shapes: flat, as `reduce_slots` leaves them.
        v_depths: flat float32 (I, N), or empty if depth has no gradient.
        v_compensations: flat float32 (I, N), read only if `antialiased`.
        want_cameras: whether `v_cameras` is wanted.
        v_means, v_quats, v_scales: out, flat float32 (S, N, k).
        v_cameras: out, float64 (I, pieces, 12); rotation row by row, then translation, one sum
            for each piece of Gaussians.
    """
    images = cameras.shape[0]
    pieces = max(1, gaussians // PIECE)
    zero = fill_exact(0.0)
    while True:
        piece = next_job(worker, counters, ends)
        if piece < 0:
            break
        begin, stop = piece * gaussians // pieces, (piece + 1) * gaussians // pieces
        for i in range(images):
            camera = cameras[i]
            clear_first(v_means, 3, i, repeats[0], gaussians, begin, stop)
            clear_first(v_quats, 4, i, repeats[1], gaussians, begin, stop)
            clear_first(v_scales, 3, i, repeats[2], gaussians, begin, stop)
            back_x, back_y, back_z = camera[0:3], camera[3:6], camera[6:9]
            sum_x, sum_y, sum_z = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
            moved = (zero, zero, zero)
            for start in range(begin, stop, GROUP):
                first = min(start, stop - GROUP)
                at = i * gaussians + first
                (depth,) = load1(depths, at)
                # The last group of a piece reaches back; what it saw before counts once.
                seen = (depth > 0.0) & (lane_index() >= np.float64(start - first))
                m = load3(means, (i // repeats[0] * gaussians + first) * 3)
                x = to_camera(camera, 0, m[0], m[1], m[2])
                y = to_camera(camera, 1, m[0], m[1], m[2])
                z = select(seen, to_camera(camera, 2, m[0], m[1], m[2]), 1.0)
                qw, qx, qy, qz = load4(quats, (i // repeats[1] * gaussians + first) * 4)
                over = 1.0 / square_root(qw * qw + qx * qx + qy * qy + qz * qz)
                qw, qx, qy, qz = qw * over, qx * over, qy * over, qz * over
                turn = rotation(qw, qx, qy, qz)
                size = load3(scales, (i // repeats[2] * gaussians + first) * 3)
                inverse = 1.0 / z
                fx, fy = camera[12], camera[13]
                tan_x, tan_y = x * inverse, y * inverse
                held_x = clamp(tan_x, camera[16], camera[17])
                held_y = clamp(tan_y, camera[18], camera[19])
                t_x = jacobian_row(camera, 0, inverse * fx, held_x)
                t_y = jacobian_row(camera, 1, inverse * fy, held_y)
                w_x, w_y = times(t_x, turn), times(t_y, turn)
                u, v = scaled(w_x, size), scaled(w_y, size)
                normal = cross(u, v)
                area = dot(normal, normal)
                trace_x, trace_y = dot(u, u), dot(v, v)
                B, C = dot(u, v), trace_y + eps2d
                det = area + (trace_x + trace_y) * eps2d + eps2d * eps2d

                v_px, v_py = load2(v_means2d, 2 * at)
                v_log_a, v_log_c, v_shear = load3(v_shapes, 3 * at)
                v_u, v_v = shape_gradient(
                    u, v, normal, C, det, 0.0 - B / C, eps2d, v_log_a, v_log_c, v_shear
                )
                if antialiased:
                    (v_ratio,) = load1(v_compensations, at)
                    more_u, more_v = compensation_gradient(u, v, normal, area, det, eps2d, v_ratio)
                    v_u, v_v = plus(v_u, more_u), plus(v_v, more_v)

                v_size = plus(scaled(v_u, w_x), scaled(v_v, w_y))
                v_wx, v_wy = scaled(v_u, size), scaled(v_v, size)
                v_turn = (
                    plus(by(v_wx, t_x[0]), by(v_wy, t_y[0])),
                    plus(by(v_wx, t_x[1]), by(v_wy, t_y[1])),
                    plus(by(v_wx, t_x[2]), by(v_wy, t_y[2])),
                )
                v_q = quaternion_gradient(qw, qx, qy, qz, over, v_turn)
                v_tx = (dot(turn[0], v_wx), dot(turn[1], v_wx), dot(turn[2], v_wx))
                v_ty = (dot(turn[0], v_wy), dot(turn[1], v_wy), dot(turn[2], v_wy))

                scale_x, scale_y = inverse * fx, inverse * fy
                v_scale_x = dot(v_tx, t_x) / scale_x
                v_scale_y = dot(v_ty, t_y) / scale_y
                along_x = v_tx[0] * back_z[0] + v_tx[1] * back_z[1] + v_tx[2] * back_z[2]
                along_y = v_ty[0] * back_z[0] + v_ty[1] * back_z[1] + v_ty[2] * back_z[2]
                free_x = (tan_x >= camera[16]) & (tan_x <= camera[17])
                free_y = (tan_y >= camera[18]) & (tan_y <= camera[19])
                v_tan_x = v_px * fx - select(free_x, scale_x * along_x, zero)
                v_tan_y = v_py * fy - select(free_y, scale_y * along_y, zero)
                v_inverse = v_scale_x * fx + v_scale_y * fy + v_tan_x * x + v_tan_y * y
                v_z = zero - v_inverse * inverse * inverse
                if v_depths.size > 0:
                    (v_depth,) = load1(v_depths, at)
                    v_z = v_z + v_depth
                in_camera = keep(seen, (v_tan_x * inverse, v_tan_y * inverse, v_z))
                v_x, v_y, v_z = in_camera
                add_columns(
                    v_means,
                    (i // repeats[0] * gaussians + first) * 3,
                    (
                        v_x * back_x[0] + v_y * back_y[0] + v_z * back_z[0],
                        v_x * back_x[1] + v_y * back_y[1] + v_z * back_z[1],
                        v_x * back_x[2] + v_y * back_y[2] + v_z * back_z[2],
                    ),
                )
                g_w, g_x, g_y, g_z = v_q
                add_columns(
                    v_quats,
                    (i // repeats[1] * gaussians + first) * 4,
                    (
                        select(seen, g_w, zero),
                        select(seen, g_x, zero),
                        select(seen, g_y, zero),
                        select(seen, g_z, zero),
                    ),
                )
                add_columns(v_scales, (i // repeats[2] * gaussians + first) * 3, keep(seen, v_size))
                if want_cameras:
                    # J R depends on R through its own row and, by the tangent, the third.
                    m = keep(seen, m)
                    of_x = keep(seen, by(v_tx, scale_x))
                    of_y = keep(seen, by(v_ty, scale_y))
                    held = plus(
                        by(of_x, select(seen, held_x, zero)), by(of_y, select(seen, held_y, zero))
                    )
                    sum_x = plus(sum_x, plus(by(m, v_x), of_x))
                    sum_y = plus(sum_y, plus(by(m, v_y), of_y))
                    sum_z = plus(sum_z, plus(by(m, v_z), by(held, fill_exact(-1.0))))
                    moved = plus(moved, in_camera)
            if want_cameras:
                place = v_cameras[i, piece]
                for row, sums in enumerate((sum_x, sum_y, sum_z, moved)):
                    place[3 * row] = total(sums[0])
                    place[3 * row + 1] = total(sums[1])
                    place[3 * row + 2] = total(sums[2])
