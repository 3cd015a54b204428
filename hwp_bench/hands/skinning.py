"""Posing a hand (shape, correctives, kinematics, linear blend skinning) and projecting it."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from hwp_bench.base.errors import BadInput, ShapeMismatch
from hwp_bench.hands.articulation import axis_angle_to_matrix
from hwp_bench.hands.skeleton import JOINT_COUNT, SHAPE_COUNT, HandParameters, landmark_order
from hwp_bench.hands.template import HandTemplate, TemplateTensors

# The joints at each distance from the wrist, one of each finger; every template has this tree.
_LEVELS = (slice(1, None, 3), slice(2, None, 3), slice(3, None, 3))


@dataclass(frozen=True, eq=False)
class PosedHand:
    """A posed hand in B frames, in the frame that `transl` is given in; metres."""

    #: (B, V, 3) vertices.
    vertices: torch.Tensor
    #: (B, 16, 3) joints, MANO order.
    joints: torch.Tensor
    #: (B, 21, 3) joints and finger tips, OpenPose order.
    landmarks: torch.Tensor
    #: (B, 16, 4, 4) rigid motion of each joint: shaped rest space to posed space.
    transforms: torch.Tensor


def pose_hand(
    template: TemplateTensors,
    pose: torch.Tensor,
    betas: torch.Tensor,
    transl: torch.Tensor,
    *,
    flat_hand_mean: bool = True,
) -> PosedHand:
    """Pose a hand in B frames; differentiable in pose, betas and transl.

    Args:
        template: tensors of the type and on the device of the other arguments.
        pose: (B, 16, 3) axis-angle rad; joint 0 turns the whole hand about its rest wrist.
        betas: (10,) or (B, 10) shape parameters.
        transl: (B, 3) m, added last.
        flat_hand_mean: True, `pose` is the pose itself and zero is the rest mesh; False, the
            template's mean pose is added to the 15 finger joints first (MANO's
            `flat_hand_mean=False`, the convention of InterHand2.6M and of the HWP release).

    Returns:
        Vertices, joints, landmarks and joint motions.

    Raises:
        ShapeMismatch: the arguments do not describe the same frames.
        BadInput: an argument is of another type than the template.

    Source: Romero et al., "Embodied Hands" (MANO), equations 2-5; the root joint's rest place
    stays where it is when the hand turns, as in the authors' code.
    """
    frames, own = pose.shape[0] if pose.dim() else 0, template.vertices.dtype
    _check_shape("pose", pose, (frames, JOINT_COUNT, 3))
    _check_shape("betas", betas, (SHAPE_COUNT,) if betas.dim() == 1 else (frames, SHAPE_COUNT))
    _check_shape("transl", transl, (frames, 3))
    for field, value in (("pose", pose), ("betas", betas), ("transl", transl)):
        if value.dtype != own:
            raise BadInput(
                f"type is {value.dtype}, that of the template {own}",
                field=field,
                remedy="Convert it, or make the template with `to_torch(dtype)`.",
            )
    if not flat_hand_mean:
        pose = torch.cat([pose[:, :1], pose[:, 1:] + template.mean_pose], dim=1)
    rotations = axis_angle_to_matrix(pose)
    # One shape for all frames is blended once: (1, V, 3) broadcasts below.
    shapes = betas if betas.dim() == 2 else betas[None]
    rest = template.vertices + torch.einsum("vck,bk->bvc", template.shape_basis, shapes)
    rest_joints = template.joints + torch.einsum("jck,bk->bjc", template.joint_basis, shapes)
    rest_joints = rest_joints.expand(frames, -1, -1)
    if template.pose_basis is not None:
        identity = torch.eye(3, dtype=pose.dtype, device=pose.device)
        feature = (rotations[:, 1:] - identity).flatten(start_dim=1)
        rest = rest + torch.einsum("vck,bk->bvc", template.pose_basis, feature)
    turns, joints = _forward_kinematics(rotations, rest_joints)
    joints = joints + transl[:, None]
    shifts = joints - (turns @ rest_joints[..., None])[..., 0]
    vertices = _blend_skin(rest, turns, shifts, template.weights)
    top = torch.cat([turns, shifts[..., None]], dim=-1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1.0
    points = torch.cat([joints, vertices[:, template.fingertips]], dim=1)
    return PosedHand(
        vertices=vertices,
        joints=joints,
        landmarks=torch.cat([points[:, rows] for rows in _landmark_rows()], dim=1),
        transforms=torch.cat([top, bottom], dim=-2),
    )


def pose_parameters(
    template: HandTemplate, hand: HandParameters, frames: Sequence[int] | slice = slice(None)
) -> PosedHand:
    """Pose a hand in some frames, in float64 and without gradients."""
    arrays = (hand.pose[frames], hand.betas, hand.transl[frames])
    with torch.no_grad():
        return pose_hand(template.to_torch(torch.float64), *map(torch.from_numpy, arrays))


@functools.cache
def _landmark_rows() -> tuple[slice, ...]:
    """`landmark_order` as slices: numbers would be handed over to a device, which waits for it."""
    order = landmark_order()
    starts = [n for n in range(len(order)) if n == 0 or order[n] != order[n - 1] + 1]
    ends = [*starts[1:], len(order)]
    return tuple(
        slice(order[start], order[end - 1] + 1) for start, end in zip(starts, ends, strict=True)
    )


def project(
    points: torch.Tensor, viewmats: torch.Tensor, Ks: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Project points with one pinhole camera for each frame.

    Camera axes: x right, y down, z forward. The centre of the top left pixel is (0.5, 0.5).

    Args:
        points: (B, P, 3) m, world.
        viewmats: (B, 4, 4) world to camera.
        Ks: (B, 3, 3) intrinsics, px.

    Returns:
        pixels: (B, P, 2) px; a point in the camera's own plane (zero depth) gets a finite
            place far off screen, with no gradient from the division.
        depth: (B, P) m along z; not positive behind the camera.

    Raises:
        ShapeMismatch: the arguments do not describe the same frames.
    """
    frames = points.shape[0]
    _check_shape("points", points, (frames, *points.shape[1:2], 3))
    _check_shape("viewmats", viewmats, (frames, 4, 4))
    _check_shape("Ks", Ks, (frames, 3, 3))
    in_camera = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    depth = in_camera[..., 2]
    tiny = torch.finfo(depth.dtype).eps
    safe = torch.where(depth.abs() < tiny, torch.full_like(depth, tiny), depth)
    rays = torch.cat([in_camera[..., :2] / safe[..., None], torch.ones_like(safe[..., None])], -1)
    return (rays @ Ks.mT)[..., :2], depth


def only_fingertips(template: TemplateTensors) -> TemplateTensors:
    """Return the template without any vertices but the finger tips.

    Joints and landmarks are posed as before, at a small part of the cost.
    """
    tips = template.fingertips
    basis = template.pose_basis
    return replace(
        template,
        vertices=template.vertices[tips],
        shape_basis=template.shape_basis[tips],
        pose_basis=None if basis is None else basis[tips],
        weights=template.weights[tips],
        fingertips=torch.arange(len(tips), device=tips.device),
    )


def _check_shape(field: str, value: torch.Tensor, shape: tuple[int, ...]) -> None:
    if tuple(value.shape) != shape:
        raise ShapeMismatch(f"shape is {tuple(value.shape)}, expected {shape}", field=field)


def _forward_kinematics(
    rotations: torch.Tensor, rest_joints: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """World rotation (B, 16, 3, 3) and place (B, 16, 3) of every joint, level by level."""
    turn, place, parents = rotations[:, :1], rest_joints[:, :1], rest_joints[:, :1]
    wrist_turn, wrist_place = turn, place
    turns, places = [], []
    for level in _LEVELS:
        rest = rest_joints[:, level]
        place = place + (turn @ (rest - parents)[..., None])[..., 0]
        turn = turn @ rotations[:, level]
        parents = rest
        turns.append(turn)
        places.append(place)
    return (
        torch.cat([wrist_turn, torch.stack(turns, dim=2).flatten(1, 2)], dim=1),
        torch.cat([wrist_place, torch.stack(places, dim=2).flatten(1, 2)], dim=1),
    )


def _blend_skin(
    rest: torch.Tensor, turns: torch.Tensor, shifts: torch.Tensor, weights: torch.Tensor
) -> torch.Tensor:
    # Rows are the images of x, y, z and the shift: four scaled sums are about twice as fast as
    # a batch of 3x3 products on a CPU.
    motions = torch.cat([turns.mT, shifts[..., None, :]], dim=-2).flatten(start_dim=2)
    images = (weights @ motions).unflatten(-1, (4, 3))
    x, y, z = rest.split(1, dim=-1)
    return images[..., 0, :] * x + images[..., 1, :] * y + images[..., 2, :] * z + images[..., 3, :]
