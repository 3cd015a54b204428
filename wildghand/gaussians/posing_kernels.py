"""Posing a hand and its anchors on the CPU, compiled: one frame at a time, and its gradient.

The equations are those of `hwp_bench.hands.skinning.pose_hand` and
`hwp_bench.hands.anchors.anchor_frames`. Joints are computed in float64, points in float32.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from hwp_bench.base.kernels import compiled, helper
from wildghand.splat.kernels.jobs import next_job

#: Anchors that one thread places at a time.
PIECE = 512

#: Below this squared angle, rad^2, Rodrigues' factors and their slopes are taken from series.
_SMALL = 1e-3
#: Squared length under which a direction is noise, as in `hwp_bench.hands.anchors`.
_TINY = np.float32(1e-30)


@helper
def _factors(squared):
    """Rodrigues' a = sin t / t and b = (1 - cos t) / t^2, and their slopes in t^2."""
    if squared < _SMALL:
        a = 1.0 - squared / 6.0 * (1.0 - squared / 20.0 * (1.0 - squared / 42.0))
        b = 0.5 * (1.0 - squared / 12.0 * (1.0 - squared / 30.0 * (1.0 - squared / 56.0)))
        a_slope = -1.0 / 6.0 + squared / 60.0 * (1.0 - squared / 28.0)
        b_slope = -1.0 / 24.0 + squared / 360.0 * (1.0 - squared / 37.333333333333336)
        return a, b, a_slope, b_slope
    angle = math.sqrt(squared)
    a = math.sin(angle) / angle
    half = math.sin(0.5 * angle)
    b = 2.0 * half * half / squared
    return a, b, (math.cos(angle) - a) / (2.0 * squared), (0.5 * a - b) / squared


@compiled(nogil=True)
def chain(pose, rest, rotations, turns, shifts):
    """Forward kinematics of one frame.

    Args:
        pose: (16, 3) axis-angle, rad.
        rest: (16, 3) joints of the shaped rest hand, m.
        rotations: (16, 3, 3) float64, filled: of each joint against its parent.
        turns: (16, 3, 3) float64, filled: of each joint in the world.
        shifts: (16, 3) float64, filled: a point r on joint j goes to turns[j] r + shifts[j].
    """
    places = np.empty((16, 3))
    for j in range(16):
        x, y, z = float(pose[j, 0]), float(pose[j, 1]), float(pose[j, 2])
        squared = x * x + y * y + z * z
        a, b, _, _ = _factors(squared)
        rotations[j, 0, 0] = 1.0 + b * (x * x - squared)
        rotations[j, 0, 1] = b * x * y - a * z
        rotations[j, 0, 2] = b * x * z + a * y
        rotations[j, 1, 0] = b * x * y + a * z
        rotations[j, 1, 1] = 1.0 + b * (y * y - squared)
        rotations[j, 1, 2] = b * y * z - a * x
        rotations[j, 2, 0] = b * x * z - a * y
        rotations[j, 2, 1] = b * y * z + a * x
        rotations[j, 2, 2] = 1.0 + b * (z * z - squared)
        parent = 0 if j % 3 == 1 else j - 1
        for row in range(3):
            if j == 0:
                places[0, row] = rest[0, row]
                for column in range(3):
                    turns[0, row, column] = rotations[0, row, column]
                continue
            place = places[parent, row]
            for k in range(3):
                place += turns[parent, row, k] * (rest[j, k] - rest[parent, k])
            places[j, row] = place
            for column in range(3):
                turn = 0.0
                for k in range(3):
                    turn += turns[parent, row, k] * rotations[j, k, column]
                turns[j, row, column] = turn
        for row in range(3):
            shift = places[j, row]
            for k in range(3):
                shift -= turns[j, row, k] * rest[j, k]
            shifts[j, row] = shift


@compiled(nogil=True)
def chain_backward(pose, rest, rotations, turns, of_turns, of_shifts, of_rotations):
    """Gradients of `chain`, from those of turns and shifts.

    Args:
        pose, rest, rotations, turns: as given to and filled by `chain`.
        of_turns, of_shifts: float64, gradients; overwritten on the way.
        of_rotations: (16, 3, 3) float64, gradients that reach the rotations directly.

    Returns:
        (16, 3) of the pose, (16, 3) of the rest joints; float64.
    """
    of_pose, of_rest = np.zeros((16, 3)), np.zeros((16, 3))
    of_places = of_shifts
    for j in range(16):
        for row in range(3):
            for k in range(3):
                of_turns[j, row, k] -= of_shifts[j, row] * rest[j, k]
                of_rest[j, k] -= turns[j, row, k] * of_shifts[j, row]
    for j in range(15, 0, -1):
        parent = 0 if j % 3 == 1 else j - 1
        for row in range(3):
            of_places[parent, row] += of_places[j, row]
            for k in range(3):
                step = rest[j, k] - rest[parent, k]
                of_turns[parent, row, k] += of_places[j, row] * step
                across = turns[parent, row, k] * of_places[j, row]
                of_rest[j, k] += across
                of_rest[parent, k] -= across
                for column in range(3):
                    of_turns[parent, row, k] += of_turns[j, row, column] * rotations[j, k, column]
                    of_rotations[j, k, column] += turns[parent, row, k] * of_turns[j, row, column]
    for row in range(3):
        of_rest[0, row] += of_places[0, row]
        for column in range(3):
            of_rotations[0, row, column] += of_turns[0, row, column]
    for j in range(16):
        _rodrigues_backward(pose[j], of_rotations[j], of_pose[j])
    return of_pose, of_rest


@helper
def _rodrigues_backward(vector, g, out):
    """Gradient of R = I + a K + b K^2 with K^2 = v v^T - |v|^2 I in the vector v."""
    x, y, z = float(vector[0]), float(vector[1]), float(vector[2])
    squared = x * x + y * y + z * z
    a, b, a_slope, b_slope = _factors(squared)
    cross = (g[2, 1] - g[1, 2], g[0, 2] - g[2, 0], g[1, 0] - g[0, 1])
    trace = g[0, 0] + g[1, 1] + g[2, 2]
    v = (x, y, z)
    of_a = cross[0] * x + cross[1] * y + cross[2] * z
    of_b = -squared * trace
    for row in range(3):
        for column in range(3):
            of_b += v[row] * g[row, column] * v[column]
    for row in range(3):
        both = -2.0 * v[row] * trace
        for column in range(3):
            both += (g[row, column] + g[column, row]) * v[column]
        out[row] = a * cross[row] + b * both + 2.0 * v[row] * (a_slope * of_a + b_slope * of_b)


@compiled(nogil=True)
def skin(rest, joint_of, weight_of, turns, shifts, vertices):
    """Linear blend skinning of one frame.

    Args:
        rest: (V, 3) float32, shaped rest vertices, m.
        joint_of, weight_of: (V, K), joints of each vertex and their weights.
        turns, shifts: from `chain`.
        vertices: (V, 3) float32, filled, m.
    """
    matrices = np.empty((16, 3, 4), np.float32)
    for j in range(16):
        for row in range(3):
            for column in range(3):
                matrices[j, row, column] = turns[j, row, column]
            matrices[j, row, 3] = shifts[j, row]
    for v in range(len(rest)):
        x, y, z = rest[v, 0], rest[v, 1], rest[v, 2]
        a = b = c = np.float32(0.0)
        for k in range(joint_of.shape[1]):
            w = weight_of[v, k]
            m = matrices[joint_of[v, k]]
            a += w * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3])
            b += w * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3])
            c += w * (m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3])
        vertices[v, 0], vertices[v, 1], vertices[v, 2] = a, b, c


@compiled(nogil=True)
def skin_backward(of_points, corners, mix, rest, joint_of, weight_of, turns, of_rest):
    """Gradients of the skinning, from those of the anchors' positions in one frame.

    Args:
        of_points: (N, 3) float32.
        corners: (N, 3) int, vertices of each anchor's face; `mix`: (N, 3) barycentric.
        rest, joint_of, weight_of, turns: as for `skin`.
        of_rest: (V, 3) float32, filled: gradient of the rest vertices.

    Returns:
        (16, 3, 3) and (16, 3) float64: of the turns and of the shifts.
    """
    of_vertices = np.zeros((len(rest), 3))
    for n in range(len(of_points)):
        for corner in range(3):
            v, share = corners[n, corner], float(mix[n, corner])
            of_vertices[v, 0] += share * of_points[n, 0]
            of_vertices[v, 1] += share * of_points[n, 1]
            of_vertices[v, 2] += share * of_points[n, 2]
    of_turns, of_shifts = np.zeros((16, 3, 3)), np.zeros((16, 3))
    for v in range(len(rest)):
        a, b, c = of_vertices[v, 0], of_vertices[v, 1], of_vertices[v, 2]
        x, y, z = float(rest[v, 0]), float(rest[v, 1]), float(rest[v, 2])
        p = q = r = 0.0
        if a != 0.0 or b != 0.0 or c != 0.0:
            for k in range(joint_of.shape[1]):
                w, j = float(weight_of[v, k]), joint_of[v, k]
                m, t, s = turns[j], of_turns[j], of_shifts[j]
                wa, wb, wc = w * a, w * b, w * c
                t[0, 0] += wa * x
                t[0, 1] += wa * y
                t[0, 2] += wa * z
                t[1, 0] += wb * x
                t[1, 1] += wb * y
                t[1, 2] += wb * z
                t[2, 0] += wc * x
                t[2, 1] += wc * y
                t[2, 2] += wc * z
                s[0] += wa
                s[1] += wb
                s[2] += wc
                p += m[0, 0] * wa + m[1, 0] * wb + m[2, 0] * wc
                q += m[0, 1] * wa + m[1, 1] * wb + m[2, 1] * wc
                r += m[0, 2] * wa + m[1, 2] * wb + m[2, 2] * wc
        of_rest[v, 0], of_rest[v, 1], of_rest[v, 2] = p, q, r
    return of_turns, of_shifts


@compiled(nogil=True)
def vertex_normals(vertices, faces, normals):
    """Unit normals of the vertices, faces weighed by area.

    Args:
        vertices: (V, 3) float32; `faces`: (F, 3) int.
        normals: (V, 3) float32, filled; (0, 0, 1) where there is no face of any area.
    """
    normals[:] = np.float32(0.0)
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = (
            vertices[j, 0] - vertices[i, 0],
            vertices[j, 1] - vertices[i, 1],
            vertices[j, 2] - vertices[i, 2],
        )
        bx, by, bz = (
            vertices[k, 0] - vertices[i, 0],
            vertices[k, 1] - vertices[i, 1],
            vertices[k, 2] - vertices[i, 2],
        )
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        for v in (i, j, k):
            normals[v, 0] += x
            normals[v, 1] += y
            normals[v, 2] += z
    for v in range(len(normals)):
        x, y, z = _unit(normals[v, 0], normals[v, 1], normals[v, 2])
        normals[v, 0], normals[v, 1], normals[v, 2] = x, y, z


@helper
def _unit(x, y, z):
    """The direction of a vector; (0, 0, 1) of none."""
    squared = x * x + y * y + z * z
    if squared > _TINY:
        scale = np.float32(1.0) / np.sqrt(squared)
        return x * scale, y * scale, z * scale
    return np.float32(0.0), np.float32(0.0), np.float32(1.0)


@compiled(nogil=True)
def place_anchors(
    worker, counters, ends, vertices, normals, transl, corners, first_edge, mix, positions,
    orientations,
):  # fmt: skip
    """Positions and frames of anchors, see `hwp_bench.hands.anchors.anchor_frames`.

    Args:
        worker, counters, ends: see `wildghand.splat.threads.run`; a job is `PIECE` anchors.
        vertices, normals: (V, 3) float32; transl: (3,) m, added to the positions.
        corners: (N, 3) int; `first_edge`: (N, 2) int, its vertices; `mix`: (N, 3) float32.
        positions: (N, 3) float32, filled, m.
        orientations: (N, 4) float32, filled: unit quaternions (w, x, y, z).
    """
    job = next_job(worker, counters, ends)
    while job >= 0:
        for n in range(PIECE * job, min(PIECE * (job + 1), len(corners))):
            px = py = pz = nx = ny = nz = np.float32(0.0)
            for corner in range(3):
                v, share = corners[n, corner], mix[n, corner]
                px += share * vertices[v, 0]
                py += share * vertices[v, 1]
                pz += share * vertices[v, 2]
                nx += share * normals[v, 0]
                ny += share * normals[v, 1]
                nz += share * normals[v, 2]
            positions[n, 0] = px + transl[0]
            positions[n, 1] = py + transl[1]
            positions[n, 2] = pz + transl[2]
            nx, ny, nz = _unit(nx, ny, nz)
            i, j = first_edge[n, 0], first_edge[n, 1]
            ex, ey, ez = (
                vertices[j, 0] - vertices[i, 0],
                vertices[j, 1] - vertices[i, 1],
                vertices[j, 2] - vertices[i, 2],
            )
            along = ex * nx + ey * ny + ez * nz
            ex, ey, ez = ex - along * nx, ey - along * ny, ez - along * nz
            if not ex * ex + ey * ey + ez * ez > _TINY:
                ex, ey, ez = _perpendicular(nx, ny, nz)
            tx, ty, tz = _unit(ex, ey, ez)
            bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
            _quaternion(tx, ty, tz, bx, by, bz, nx, ny, nz, orientations[n])
        job = next_job(worker, counters, ends)


@helper
def _perpendicular(x, y, z):
    """A direction across a unit vector: across the axis that it is farthest from."""
    zero = np.float32(0.0)
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        return zero, z, -y
    if abs(y) <= abs(z):
        return -z, zero, x
    return y, -x, zero


@helper
def _quaternion(tx, ty, tz, bx, by, bz, nx, ny, nz, out):
    """Shepperd's quaternion of the rotation with the columns t, b and n."""
    one = np.float32(1.0)
    squares = (one + tx + by + nz, one + tx - by - nz, one - tx + by - nz, one - tx - by + nz)
    wx, wy, wz = bz - ny, nx - tz, ty - bx
    xy, xz, yz = bx + ty, nx + tz, ny + bz
    best = 0
    for k in range(1, 4):
        if squares[k] > squares[best]:
            best = k
    if best == 0:
        w, x, y, z = squares[0], wx, wy, wz
    elif best == 1:
        w, x, y, z = wx, squares[1], xy, xz
    elif best == 2:
        w, x, y, z = wy, xy, squares[2], yz
    else:
        w, x, y, z = wz, xz, yz, squares[3]
    scale = one / np.sqrt(w * w + x * x + y * y + z * z)
    out[0], out[1], out[2], out[3] = w * scale, x * scale, y * scale, z * scale
