"""Anchors of a posed hand on the CPU, float32: what `HandRig.follow` asks of torch elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hwp_bench.hands import TemplateTensors
from hwp_bench.hands.anchors import SurfaceAnchors
from wildghand.gaussians import posing_kernels as kernels
from wildghand.splat.threads import run_pieces


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
        """The tables of anchors on a template.

        Args:
            template: float32, on the CPU.
            anchors: N anchors.
        """
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
            kernels.vertex_normals(vertices, tables.faces, normals)
            run_pieces(
                kernels.place_anchors,
                count,
                kernels.PIECE,
                count,
                vertices,
                normals,
                move,
                tables.corners,
                tables.first_edge,
                tables.mix,
                positions[f],
                orientations[f],
            )
            frames.append(frame)
        made = torch.from_numpy(positions), torch.from_numpy(orientations)
        ctx.tables, ctx.frames, ctx.shared = tables, frames, betas.dim() == 1
        ctx.mark_non_differentiable(made[1])
        return made

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
        return (
            torch.stack(pose),
            of_betas.sum(dim=0) if ctx.shared else of_betas,
            gradients[0].sum(dim=1),
            None,
        )


def warm_up() -> None:
    """Make the kernels ready, on a hand of one face: compiled once on a machine, loaded later."""
    zeros = torch.zeros
    template = TemplateTensors(
        vertices=zeros(3, 3),
        faces=torch.tensor([[0, 1, 2]]),
        shape_basis=zeros(3, 3, 10),
        pose_basis=None,
        joints=zeros(16, 3),
        joint_basis=zeros(16, 3, 10),
        weights=torch.full((3, 16), 1 / 16),
        mean_pose=zeros(15, 3),
        fingertips=zeros(5, dtype=torch.int64),
    )
    anchors = SurfaceAnchors(zeros(1, dtype=torch.int64), torch.full((1, 3), 1 / 3))
    pose = zeros(1, 16, 3, requires_grad=True)
    tables = PosingTables.of(template, anchors)
    with torch.enable_grad():
        FollowCpu.apply(pose, zeros(10), zeros(1, 3), tables)[0].sum().backward()


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
    kernels.chain(pose, joints, frame.rotations, frame.turns, shifts)
    if template.pose_basis is not None:
        feature = (frame.rotations[1:] - np.eye(3)).astype(np.float32).reshape(-1)
        rest += (template.pose_basis.flatten(0, 1) @ torch.from_numpy(feature)).view(-1, 3)
    kernels.skin(frame.rest, tables.joint_of, tables.weight_of, frame.turns, shifts, vertices)
    return frame


def _frame_backward(
    frame: _Frame, of_points: np.ndarray, tables: PosingTables
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of pose (16, 3), rest vertices (V * 3,) and rest joints (48,)."""
    of_rest = np.empty_like(frame.rest)
    of_turns, of_shifts = kernels.skin_backward(
        of_points,
        tables.corners,
        tables.mix,
        frame.rest,
        tables.joint_of,
        tables.weight_of,
        frame.turns,
        of_rest,
    )
    rest = torch.from_numpy(of_rest).flatten()
    of_rotations = np.zeros((16, 3, 3))
    basis = tables.template.pose_basis
    if basis is not None:
        of_rotations[1:] = (basis.flatten(0, 1).mT @ rest).numpy().reshape(15, 3, 3)
    of_pose, of_joints = kernels.chain_backward(
        frame.pose,
        frame.rest_joints,
        frame.rotations,
        frame.turns,
        of_turns,
        of_shifts,
        of_rotations,
    )
    return (
        torch.from_numpy(of_pose).float(),
        rest,
        torch.from_numpy(of_joints).float().flatten(),
    )
