"""How far the points of an outline move in the image when the unknowns of the person change."""

from __future__ import annotations

import numpy as np

from hwp_bench.hands.skeleton import JOINT_COUNT
from wildghand.subject.compared_frames import ComparedFrames, PosedFrames
from wildghand.subject.linear_hand import joint_turns, vertex_turns
from wildghand.subject.outlines import OutlinePoints
from wildghand.subject.shape import side_flip
from wildghand.subject.unknowns import Unknowns


def outline_rows(
    unknowns: Unknowns,
    frames: ComparedFrames,
    posed: PosedFrames,
    frame: int,
    seen: OutlinePoints,
) -> np.ndarray:
    """Rows of the linear problem of one frame.

    Args:
        unknowns: N of them.
        frames: that are compared.
        posed: the hands in them.
        frame: row of the frame, from 0.
        seen: M points of the outline in it.

    Returns:
        (M, N) float32, px along the outward direction of each point for a unit of each unknown.
    """
    at = frames.faces[seen.face]
    slope = _slopes(frames, posed, frame, seen, at)
    result = np.zeros((len(at), len(unknowns)), dtype=np.float32)
    nodes, joints, proportions = unknowns.cuts
    for index, (side, template) in enumerate(frames.templates.items()):
        mine = np.flatnonzero(at[:, 0] // frames.count == index)
        if not len(mine):
            continue
        count, flip, turns = len(mine), side_flip(side), posed.turns[index][frame]
        corner, mix = at[mine] - index * frames.count, seen.mix[mine]
        used, where = np.unique(corner, return_inverse=True)
        where = where.reshape(corner.shape)
        # Of the rest vertices at the three corners of each point's face, (M, 3, 3).
        moved = vertex_turns(turns, template.weights[used])[where]
        of_corners = mix[..., None] * (slope[mine, None, None] @ moved)[:, :, 0] * flip
        # Of the rest joints, (M, 48).
        bones = joint_turns(turns, template.weights[used]).reshape(len(used), -1)
        bones = np.einsum("mc,mcx->mx", mix, bones[where]).reshape(count, JOINT_COUNT, 3, 3)
        of_joints = (np.einsum("mi,mjik->mjk", slope[mine], bones) * flip).reshape(count, -1)

        shares = unknowns.points.shares[used][where].transpose(0, 2, 1)
        result[mine, :nodes] = (shares @ of_corners).reshape(count, -1)
        result[mine, nodes:joints] = of_joints
        stretched = unknowns.proportions.vertices[used][where].reshape(count, 9, -1)
        carried = unknowns.proportions.joints.reshape(3 * JOINT_COUNT, -1)
        result[mine, joints:proportions] = (
            np.einsum("mx,mxs->ms", of_corners.reshape(count, 9), stretched) + of_joints @ carried
        )
        start = proportions + 3 * (index * len(frames) + frame)
        result[mine, start : start + 3] = slope[mine]
    return result


def _slopes(
    frames: ComparedFrames, posed: PosedFrames, frame: int, seen: OutlinePoints, at: np.ndarray
) -> np.ndarray:
    """(M, 3) px along the outward direction for each metre that a posed point moves."""
    viewmat, K = frames.viewmats[frame], frames.Ks[frame]
    place = np.einsum("mc,mck->mk", seen.mix, posed.meshes[frame][at])
    camera = place @ viewmat[:3, :3].T + viewmat[:3, 3]
    away = camera[:, 2:]
    focal = seen.outward * [K[0, 0], K[1, 1]]
    along = -(focal * camera[:, :2]).sum(axis=1, keepdims=True) / away**2
    slope: np.ndarray = np.concatenate([focal / away, along], axis=1) @ viewmat[:3, :3]
    return slope
