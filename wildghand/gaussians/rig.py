"""Anchors on one hand, posed frame by frame; the Gaussians ride on them.

On the CPU, float32, posing is compiled, with its gradient by hand. The equations are those of
`hwp_bench.hands.skinning.pose_hand` and `hwp_bench.hands.anchors.anchor_frames`. Joints are
computed in float64, points in float32.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.kernels import helper
from hwp_bench.hands import HandTemplate, TemplateTensors, load_template, pose_hand
from hwp_bench.hands.anchors import SurfaceAnchors, anchor_frames, anchor_positions, sample_surface
from wildghand.gaussians.quaternions import matrix_to_quat
from wildghand.splat.kernels.jit import jobs, kernel
from wildghand.splat.kernels.triples import by, cross, dot, get, minus, plus, put, times
from wildghand.splat.threads import kernels_take, run_pieces

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


@kernel
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
        xy, xz, yz = b * x * y, b * x * z, b * y * z
        put(rotations[j], 0, (1.0 + b * (x * x - squared), xy - a * z, xz + a * y))
        put(rotations[j], 1, (xy + a * z, 1.0 + b * (y * y - squared), yz - a * x))
        put(rotations[j], 2, (xz - a * y, yz + a * x, 1.0 + b * (z * z - squared)))
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


@kernel
def chain_backward(pose, rest, rotations, turns, of_turns, of_shifts, of_rotations):
    """Gradients of `chain`, from those of turns and shifts.

    Args:
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


@kernel
def skin(rest, joint_of, weight_of, turns, shifts, vertices):
    """Linear blend skinning of one frame.

    Args:
        rest: (V, 3) float32, shaped rest vertices, m.
        joint_of, weight_of: (V, K), joints of each vertex and their weights.
        vertices: (V, 3) float32, filled, m.
    """
    matrices = np.empty((16, 3, 4), np.float32)
    for j in range(16):
        for row in range(3):
            for column in range(3):
                matrices[j, row, column] = turns[j, row, column]
            matrices[j, row, 3] = shifts[j, row]
    for v in range(len(rest)):
        point = get(rest, v)
        a = b = c = np.float32(0.0)
        for k in range(joint_of.shape[1]):
            w = weight_of[v, k]
            m = matrices[joint_of[v, k]]
            a += w * (dot(get(m, 0), point) + m[0, 3])
            b += w * (dot(get(m, 1), point) + m[1, 3])
            c += w * (dot(get(m, 2), point) + m[2, 3])
        put(vertices, v, (a, b, c))


@kernel
def skin_backward(of_points, corners, mix, rest, joint_of, weight_of, turns, of_rest):
    """Gradients of the skinning, from those of the anchors' positions in one frame.

    Args:
        of_points: (N, 3) float32.
        corners: (N, 3) int, vertices of each anchor's face; `mix`: (N, 3) barycentric.
        of_rest: (V, 3) float32, filled: gradient of the rest vertices.

    Returns:
        (16, 3, 3) and (16, 3) float64: of the turns and of the shifts.
    """
    of_vertices = np.zeros((len(rest), 3))
    for n in range(len(of_points)):
        for corner in range(3):
            v, share = corners[n, corner], float(mix[n, corner])
            for i in range(3):
                of_vertices[v, i] += share * of_points[n, i]
    of_turns, of_shifts = np.zeros((16, 3, 3)), np.zeros((16, 3))
    for v in range(len(rest)):
        g, point = get(of_vertices, v), rest[v]
        found = (0.0, 0.0, 0.0)
        if g[0] != 0.0 or g[1] != 0.0 or g[2] != 0.0:
            for k in range(joint_of.shape[1]):
                j = joint_of[v, k]
                share = by(g, float(weight_of[v, k]))
                for row in range(3):
                    for column in range(3):
                        of_turns[j, row, column] += share[row] * float(point[column])
                    of_shifts[j, row] += share[row]
                m = turns[j]
                found = plus(found, times(share, (get(m, 0), get(m, 1), get(m, 2))))
        put(of_rest, v, found)
    return of_turns, of_shifts


@kernel
def vertex_normals(vertices, faces, normals):
    """Unit normals (V, 3), faces weighed by area; (0, 0, 1) where there is no face of any area."""
    normals[:] = np.float32(0.0)
    for f in range(len(faces)):
        start = get(vertices, faces[f, 0])
        edges = minus(get(vertices, faces[f, 1]), start), minus(get(vertices, faces[f, 2]), start)
        normal = cross(*edges)
        for v in faces[f]:
            put(normals, v, plus(get(normals, v), normal))
    for v in range(len(normals)):
        put(normals, v, _unit(get(normals, v)))


@helper
def _unit(a):
    """The direction of a vector; (0, 0, 1) of none."""
    squared = dot(a, a)
    if squared > _TINY:
        return by(a, np.float32(1.0) / np.sqrt(squared))
    return np.float32(0.0), np.float32(0.0), np.float32(1.0)


@kernel
def place_anchors(
    worker, counters, ends, vertices, normals, transl, corners, first_edge, mix, positions,
    orientations,
):  # fmt: skip
    """Positions and frames of anchors, see `hwp_bench.hands.anchors.anchor_frames`.

    Args:
        vertices, normals: (V, 3) float32; transl: (3,) m, added to the positions.
        corners: (N, 3) int; `first_edge`: (N, 2) int, its vertices; `mix`: (N, 3) float32.
        positions: (N, 3) float32, filled, m.
        orientations: (N, 4) float32, filled: unit quaternions (w, x, y, z).
    """
    for job in jobs(worker, counters, ends):
        for n in range(PIECE * job, min(PIECE * (job + 1), len(corners))):
            position = normal = (np.float32(0.0), np.float32(0.0), np.float32(0.0))
            for corner in range(3):
                v, share = corners[n, corner], mix[n, corner]
                position = plus(position, by(get(vertices, v), share))
                normal = plus(normal, by(get(normals, v), share))
            put(positions, n, plus(position, (transl[0], transl[1], transl[2])))
            normal = _unit(normal)
            i, j = first_edge[n, 0], first_edge[n, 1]
            edge = minus(get(vertices, j), get(vertices, i))
            edge = minus(edge, by(normal, dot(edge, normal)))
            if not dot(edge, edge) > _TINY:
                edge = _perpendicular(normal)
            tangent = _unit(edge)
            _quaternion(tangent, cross(normal, tangent), normal, orientations[n])


@helper
def _perpendicular(a):
    """A direction across a unit vector: across the axis that it is farthest from."""
    x, y, z = a
    zero = np.float32(0.0)
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        return zero, z, -y
    if abs(y) <= abs(z):
        return -z, zero, x
    return y, -x, zero


@helper
def _quaternion(t, b, n, out):
    """Shepperd's quaternion of the rotation with the columns t, b and n."""
    one = np.float32(1.0)
    x, y, z = t[0], b[1], n[2]
    squares = (one + x + y + z, one + x - y - z, one - x + y - z, one - x - y + z)
    wx, wy, wz = b[2] - n[1], n[0] - t[2], t[1] - b[0]
    xy, xz, yz = b[0] + t[1], n[0] + t[2], n[1] + b[2]
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


@dataclass(frozen=True, eq=False)
class PosingTables:
    """The arrays of a rig that the kernels read; they never change."""

    #: The template's own tensors.
    template: TemplateTensors
    #: (V, K) int32, joints of each vertex; K is the largest number that any vertex has.
    joint_of: np.ndarray
    #: (V, K) float32, their weights; 0 where a vertex has fewer.
    weight_of: np.ndarray
    #: (F, 3) int32.
    faces: np.ndarray
    #: (N, 3) int32, vertices of each anchor's face.
    corners: np.ndarray
    #: (N, 2) int32, the first edge of that face.
    first_edge: np.ndarray
    #: (N, 3) float32, barycentric coordinates.
    mix: np.ndarray

    @classmethod
    def of(cls, template: TemplateTensors, anchors: SurfaceAnchors) -> PosingTables:
        """The tables of anchors on a float32 template on the CPU."""
        weights = template.weights.numpy()
        most = max(1, int((weights != 0.0).sum(axis=1).max()))
        order = np.argsort(-np.abs(weights), axis=1, kind="stable")[:, :most]
        faces = template.faces.numpy().astype(np.int32)
        corners = faces[np.asarray(anchors.face_index)]
        return cls(
            template=template,
            joint_of=order.astype(np.int32),
            weight_of=np.ascontiguousarray(np.take_along_axis(weights, order, axis=1)),
            faces=faces,
            corners=corners,
            first_edge=np.ascontiguousarray(corners[:, :2]),
            mix=np.ascontiguousarray(np.asarray(anchors.barycentric), dtype=np.float32),
        )


@dataclass(frozen=True, eq=False)
class _Frame:
    """Arrays of one frame that its gradient needs again."""

    pose: np.ndarray
    rest: np.ndarray
    rest_joints: np.ndarray
    rotations: np.ndarray
    turns: np.ndarray


class FollowCpu(torch.autograd.Function):
    """Positions (F, N, 3) and orientations (F, N, 4) of anchors; the latter without gradient.

    Arguments: pose (F, 16, 3), betas (10,) or (F, 10), transl (F, 3), and `PosingTables`.
    """

    @staticmethod
    def forward(
        ctx: Any, pose: Tensor, betas: Tensor, transl: Tensor, tables: PosingTables
    ) -> tuple[Tensor, Tensor]:
        """Pose every frame."""
        shapes = betas.detach().expand(len(pose), -1)
        count, vertices = len(tables.corners), np.empty_like(tables.template.vertices.numpy())
        positions = np.empty((len(pose), count, 3), np.float32)
        orientations = np.empty((len(pose), count, 4), np.float32)
        normals = np.empty_like(vertices)
        frames = []
        given = pose.detach().numpy(), transl.detach().numpy()
        for f, (turn, move, shape) in enumerate(zip(*given, shapes, strict=True)):
            frame = _pose_frame(turn, shape, tables, vertices)
            vertex_normals(vertices, tables.faces, normals)
            surface = (vertices, normals, move, tables.corners, tables.first_edge, tables.mix)
            made = (positions[f], orientations[f])
            run_pieces(place_anchors, count, PIECE, count, *surface, *made)
            frames.append(frame)
        posed = torch.from_numpy(positions), torch.from_numpy(orientations)
        ctx.tables, ctx.frames, ctx.shared = tables, frames, betas.dim() == 1
        ctx.mark_non_differentiable(posed[1])
        return posed

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of pose, betas and transl."""
        template = ctx.tables.template
        of_points = gradients[0].contiguous().numpy()
        pose, betas = [], []
        for frame, of_frame in zip(ctx.frames, of_points, strict=True):
            of_pose, of_rest, of_joints = _frame_backward(frame, of_frame, ctx.tables)
            pose.append(of_pose)
            betas.append(
                template.shape_basis.flatten(0, 1).mT @ of_rest
                + template.joint_basis.flatten(0, 1).mT @ of_joints
            )
        of_betas = torch.stack(betas)
        of_betas = of_betas.sum(dim=0) if ctx.shared else of_betas
        return torch.stack(pose), of_betas, gradients[0].sum(dim=1), None


def _pose_frame(
    pose: np.ndarray, betas: Tensor, tables: PosingTables, vertices: np.ndarray
) -> _Frame:
    """Fill the vertices (V, 3) of one frame without its translation.

    Far from the origin float32 would round away what directions are made of.
    """
    template = tables.template
    # One matrix and one vector: a product of a stack of small matrices takes ten times as long.
    rest = template.vertices + (template.shape_basis.flatten(0, 1) @ betas).view(-1, 3)
    joints = (template.joints + (template.joint_basis.flatten(0, 1) @ betas).view(-1, 3)).numpy()
    frame = _Frame(pose, rest.numpy(), joints, np.empty((16, 3, 3)), np.empty((16, 3, 3)))
    shifts = np.empty((16, 3))
    chain(pose, joints, frame.rotations, frame.turns, shifts)
    if template.pose_basis is not None:
        feature = (frame.rotations[1:] - np.eye(3)).astype(np.float32).reshape(-1)
        rest += (template.pose_basis.flatten(0, 1) @ torch.from_numpy(feature)).view(-1, 3)
    skin(frame.rest, tables.joint_of, tables.weight_of, frame.turns, shifts, vertices)
    return frame


def _frame_backward(
    frame: _Frame, of_points: np.ndarray, tables: PosingTables
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of pose (16, 3), rest vertices (V * 3,) and rest joints (48,)."""
    of_rest = np.empty_like(frame.rest)
    joints = (tables.joint_of, tables.weight_of)
    of_turns, of_shifts = skin_backward(
        of_points, tables.corners, tables.mix, frame.rest, *joints, frame.turns, of_rest
    )
    rest = torch.from_numpy(of_rest).flatten()
    of_rotations = np.zeros((16, 3, 3))
    basis = tables.template.pose_basis
    if basis is not None:
        of_rotations[1:] = (basis.flatten(0, 1).mT @ rest).numpy().reshape(15, 3, 3)
    forward = (frame.pose, frame.rest_joints, frame.rotations, frame.turns)
    of_pose, of_joints = chain_backward(*forward, of_turns, of_shifts, of_rotations)
    return torch.from_numpy(of_pose).float(), rest, torch.from_numpy(of_joints).float().flatten()


#: Frames that are posed at a time, so that memory does not grow with the clip.
CHUNK = 32


@dataclass(frozen=True, eq=False)
class AnchorPoses:
    """N anchors in F frames, world coordinates."""

    #: (F, N, 3) m.
    positions: torch.Tensor
    #: (F, N, 4) unit quaternions (w, x, y, z) of the surface frames; z is the normal.
    orientations: torch.Tensor


@dataclass(frozen=True, eq=False)
class HandRig:
    """The anchors of one hand."""

    #: The template, as posing reads it.
    template: TemplateTensors
    #: N anchors.
    anchors: SurfaceAnchors
    #: Mean distance between neighbouring anchors on the rest surface, m.
    spacing: float

    def __len__(self) -> int:
        return len(self.anchors)

    @torch.no_grad()
    def pose(self, pose: torch.Tensor, betas: torch.Tensor, transl: torch.Tensor) -> AnchorPoses:
        """Pose the anchors in F frames, (F, 16, 3) rad, (10,) and (F, 3) m; no gradient."""
        # Filled part by part: joining finished parts would hold all of them twice.
        posed = AnchorPoses(
            pose.new_empty(len(pose), len(self), 3), pose.new_empty(len(pose), len(self), 4)
        )
        for start in range(0, len(pose), CHUNK):
            part = slice(start, start + CHUNK)
            found = self.follow(pose[part], betas, transl[part])
            posed.positions[part] = found.positions
            posed.orientations[part] = found.orientations
        return posed

    def follow(self, pose: torch.Tensor, betas: torch.Tensor, transl: torch.Tensor) -> AnchorPoses:
        """Pose the anchors of a few frames; the positions are differentiable.

        Poses (F, 16, 3) rad, shapes (10,) or (F, 10), translations (F, 3) m. The frames of the
        anchors carry no gradient: it would double the cost, and turning a splat changes the image
        much less than moving it.
        """
        if kernels_take(self.template.vertices, pose, betas, transl):
            return AnchorPoses(*FollowCpu.apply(pose, betas, transl, self.tables))
        faces = self.template.faces
        vertices = pose_hand(self.template, pose, betas, transl).vertices
        with torch.no_grad():
            orientations = matrix_to_quat(anchor_frames(vertices, faces, self.anchors))
        return AnchorPoses(anchor_positions(vertices, faces, self.anchors), orientations)

    @functools.cached_property
    def tables(self) -> PosingTables:
        """Tables for posing on the CPU; made once."""
        return PosingTables.of(self.template, self.anchors)


def make_rig(
    template: HandTemplate,
    count: int,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> HandRig:
    """Spread `count` anchors evenly over a hand; `seed` is that of the anchors."""
    return rig_of(template, sample_surface(template, count, seed), device)


def rig_of(
    template: HandTemplate, anchors: SurfaceAnchors, device: torch.device | str = "cpu"
) -> HandRig:
    """Make a rig of given anchors; see `make_rig`."""
    tensors = template.to_torch(torch.float32, device)
    corners = tensors.vertices[tensors.faces]
    edges = corners[:, 1:] - corners[:, :1]
    area = 0.5 * torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=-1).sum()
    spacing = float((area / len(anchors)).sqrt())
    return HandRig(tensors, anchors.to_torch(torch.float32, device), spacing)


def warm_up_posing() -> None:
    """Make the kernels ready: compiled once on a machine, loaded later."""
    pose = torch.zeros(1, 16, 3, requires_grad=True)
    with torch.enable_grad():
        posed = make_rig(load_template(), 1).follow(pose, torch.zeros(10), torch.zeros(1, 3))
        posed.positions.sum().backward()
