"""The subject's own hand: the template bent until its outlines meet those of the masks.

Posed points are linear in the rest surface and the rest joints, so each round is one linear least
squares problem: outlines are drawn, every point of them is asked to move by its gap to the mask's
outline, and control points, joints and the frames' translations share what is asked. Gaps that
nothing smooth explains (an object in front, a blurred border, a wrong mask) count less and less.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from scipy.linalg import solve

from hwp_bench.capture import Cameras
from hwp_bench.hands import (
    HandParameters,
    HandTemplate,
    TemplateTensors,
    boundary_vertices,
    pose_hand,
    project,
)
from hwp_bench.hands.skeleton import PARENTS
from hwp_bench.hands.template import JOINT_COUNT
from wildghand.subject.control_points import ControlPoints, place_control_points
from wildghand.subject.linear_hand import joint_turns, vertex_turns
from wildghand.subject.outlines import OutlinePoints, compare_outlines
from wildghand.subject.settings import SubjectSettings
from wildghand.subject.shape import SubjectShape, side_flip

# Points of the rest hand nearer to its open end than this are not compared: the mask ends where a
# sleeve does, m.
_WRIST = 0.015
# The reach in the first round, in those of the last.
_FIRST_REACH = 3.0
# Least number of points that a fit needs.
_LEAST = 100


def fit_subject(
    templates: Mapping[str, HandTemplate],
    hands: Mapping[str, HandParameters],
    cameras: Cameras,
    frames: np.ndarray,
    masks: np.ndarray,
    settings: SubjectSettings,
) -> SubjectShape:
    """Fit a person's hand to masks; deterministic.

    Args:
        templates: by side.
        hands: parameters of every frame, by side.
        cameras: of every frame.
        frames: (R,) numbers of the frames with masks, ascending.
        masks: (R, H, W) uint8, 255 = visible hand.
        settings: how.

    Returns:
        The shape; zeros where too little can be compared.
    """
    first = next(iter(templates.values()))
    shape = SubjectShape(np.zeros_like(first.vertices), np.zeros((JOINT_COUNT, 3)))
    picks = np.unique(np.linspace(0, len(frames) - 1, settings.frames).round().astype(int))
    problem = _Problem(templates, hands, cameras, frames[picks], masks[picks] > 127, settings)
    transl = np.zeros((len(templates), len(picks), 3))
    for fraction in np.linspace(0.0, 1.0, settings.rounds):
        reach = settings.reach * _FIRST_REACH ** (1.0 - fraction)
        solved = problem.solve(shape, transl, reach)
        if solved is None:
            break
        shape, transl = solved
    # An avatar keeps float32: it is drawn with what is read again.
    return SubjectShape(
        shape.vertices.astype(np.float32).astype(np.float64),
        shape.joints.astype(np.float32).astype(np.float64),
    )


class _Problem:
    """The frames that are compared, and the linear problem of one round."""

    def __init__(
        self,
        templates: Mapping[str, HandTemplate],
        hands: Mapping[str, HandParameters],
        cameras: Cameras,
        frames: np.ndarray,
        masks: np.ndarray,
        settings: SubjectSettings,
    ) -> None:
        self.templates, self.settings, self.masks = dict(templates), settings, masks
        self.parameters = {
            side: (hands[side].pose[frames], hands[side].betas, hands[side].transl[frames])
            for side in templates
        }
        self.viewmats, self.Ks = cameras.viewmats[frames], cameras.Ks[frames]
        first = next(iter(templates.values()))
        self.points: ControlPoints = place_control_points(first, settings.nodes)
        self.near_wrist = _near_open_end(first)
        self.count = len(first.vertices)
        self.faces = np.concatenate(
            [one.faces + index * self.count for index, one in enumerate(templates.values())]
        )
        self.ring = _joint_surroundings(first)
        self.expected = self._expected()
        self.values = np.zeros(self._size())

    def _size(self) -> int:
        return 3 * (self.points.shares.shape[1] + JOINT_COUNT) + 3 * len(self.templates) * len(
            self.masks
        )

    def solve(
        self, shape: SubjectShape, transl: np.ndarray, reach: float
    ) -> tuple[SubjectShape, np.ndarray] | None:
        """One round: the numbers that explain the gaps of the outlines best.

        Args:
            shape: so far.
            transl: (S, F, 3) m, added to the given translations so far.
            reach: gap at which a point counts a quarter, px.

        Returns:
            Shape and translations; None where too little can be compared.
        """
        rows, gaps = [], []
        bent = {
            side: shape.applied(template).to_torch(torch.float64)
            for side, template in self.templates.items()
        }
        quota = max(20, self.settings.points // len(self.masks))
        for frame in range(len(self.masks)):
            made = self._frame(bent, transl, frame, quota)
            if made is not None:
                rows.append(made[0])
                gaps.append(made[1])
        if not rows or sum(map(len, gaps)) < _LEAST:
            return None
        matrix, gap = np.concatenate(rows), np.concatenate(gaps)
        weight = 1.0 / (1.0 + (gap / reach) ** 2) ** 2 / self.settings.noise**2
        # The unknowns are the whole displacement, so that each round regularises all of it.
        target = gap + matrix @ self.values
        right = matrix.T @ (weight * target)
        matrix *= np.sqrt(weight).astype(np.float32)[:, None]
        normal = (matrix.T @ matrix).astype(np.float64) + self.expected
        self.values = solve(normal, right, assume_a="pos")
        nodes, joints, moves = self._parts(self.values)
        return SubjectShape(self.points.shares @ nodes, joints), moves

    def _parts(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Control points (K, 3), joints (16, 3) and translations (S, F, 3)."""
        cut = 3 * self.points.shares.shape[1]
        nodes, joints = values[:cut].reshape(-1, 3), values[cut : cut + 3 * JOINT_COUNT]
        moves = values[cut + 3 * JOINT_COUNT :].reshape(len(self.templates), -1, 3)
        return nodes, joints.reshape(-1, 3), moves

    def _frame(
        self, bent: Mapping[str, TemplateTensors], transl: np.ndarray, frame: int, quota: int
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Rows of the linear problem of one frame, and its gaps in px."""
        vertices, turns = [], []
        for index, (side, template) in enumerate(bent.items()):
            pose, betas, given = (
                torch.as_tensor(part, dtype=torch.float64)
                for part in (
                    self.parameters[side][0][frame : frame + 1],
                    self.parameters[side][1],
                    self.parameters[side][2][frame : frame + 1] + transl[index, frame],
                )
            )
            posed = pose_hand(template, pose, betas, given)
            vertices.append(posed.vertices[0])
            turns.append(posed.transforms[0, :, :3, :3].numpy())
        viewmat, K = self.viewmats[frame], self.Ks[frame]
        mesh = torch.cat(vertices)[None]
        pixels, depth = project(mesh, torch.as_tensor(viewmat)[None], torch.as_tensor(K)[None])
        corners = self.faces
        seen = compare_outlines(pixels[0].numpy(), depth[0].numpy(), corners, self.masks[frame])
        seen = self._chosen(seen, corners, quota)
        if not len(seen.gap):
            return None
        at = corners[seen.face]
        place = np.einsum("mc,mck->mk", seen.mix, mesh[0].numpy()[at])
        # px along the outward direction for each metre of the point, (M, 3).
        camera = place @ viewmat[:3, :3].T + viewmat[:3, 3]
        away = camera[:, 2:]
        focal = seen.outward * [K[0, 0], K[1, 1]]
        slope = np.concatenate(
            [focal / away, -(focal * camera[:, :2]).sum(axis=1, keepdims=True) / away**2], axis=1
        )
        slope = slope @ viewmat[:3, :3]
        result = np.zeros((len(at), self._size()), dtype=np.float32)
        self._fill(result, at, seen.mix, slope, turns, frame)
        return result, seen.gap

    def _fill(
        self,
        result: np.ndarray,
        at: np.ndarray,
        mix: np.ndarray,
        slope: np.ndarray,
        turns: list[np.ndarray],
        frame: int,
    ) -> None:
        """Write px for each metre of every unknown into the rows of one frame."""
        nodes = self.points.shares.shape[1]
        cut = 3 * nodes
        for index, (side, template) in enumerate(self.templates.items()):
            mine = np.flatnonzero(at[:, 0] // self.count == index)
            if not len(mine):
                continue
            corner, flip = at[mine] - index * self.count, side_flip(side)
            used, where = np.unique(corner, return_inverse=True)
            where = where.reshape(corner.shape)
            moved = vertex_turns(turns[index], template.weights[used])
            bones = joint_turns(turns[index], template.weights[used])
            shares = self.points.shares[used]
            surface = np.zeros((len(mine), nodes, 3))
            joints = np.zeros((len(mine), JOINT_COUNT, 3))
            for k in range(3):
                part, share = where[:, k], mix[mine, k]
                step = np.einsum("mi,mij->mj", slope[mine], moved[part]) * flip
                surface += (share[:, None] * shares[part])[..., None] * step[:, None]
                step = np.einsum("mi,mjik->mjk", slope[mine], bones[part]) * flip
                joints += share[:, None, None] * step
            result[mine, :cut] = surface.reshape(len(mine), -1)
            result[mine, cut : cut + 3 * JOINT_COUNT] = joints.reshape(len(mine), -1)
            start = cut + 3 * JOINT_COUNT + 3 * (index * len(self.masks) + frame)
            result[mine, start : start + 3] = slope[mine]

    def _chosen(self, seen: OutlinePoints, corners: np.ndarray, quota: int) -> OutlinePoints:
        """The points away from the wrist, at most `quota`, evenly spread."""
        kept = np.flatnonzero(~self.near_wrist[corners[seen.face][:, 0] % self.count])
        if len(kept) > quota:
            kept = kept[np.linspace(0, len(kept) - 1, quota).astype(np.int64)]
        return OutlinePoints(seen.face[kept], seen.mix[kept], seen.outward[kept], seen.gap[kept])

    def _expected(self) -> np.ndarray:
        """The matrix of what is expected without any gap, in px^2 for each m^2."""
        settings, nodes = self.settings, self.points.shares.shape[1]
        size = self._size()
        cut = 3 * nodes
        result = np.zeros((size, size))
        diagonal = np.full(size, 1.0 / settings.transl_spread**2)
        diagonal[:cut] = 1.0 / settings.spread**2
        diagonal[cut : cut + 3 * JOINT_COUNT] = 0.0
        result[np.arange(size), np.arange(size)] = diagonal
        first, second = self.points.pairs.T
        rough = 0.01 / (self.points.lengths * settings.roughness**2)
        laplacian = np.zeros((nodes, nodes))
        np.add.at(laplacian, (first, first), rough)
        np.add.at(laplacian, (second, second), rough)
        np.add.at(laplacian, (first, second), -rough)
        np.add.at(laplacian, (second, first), -rough)
        # Joints go where the surface around them goes.
        around = self.ring @ self.points.shares
        tie = np.concatenate([around, -np.eye(JOINT_COUNT)], axis=1)
        tied = tie.T @ tie / settings.joint_spread**2
        tied[nodes, nodes] += 1e12  # the wrist
        together = np.zeros((nodes + JOINT_COUNT,) * 2)
        together[:nodes, :nodes] = laplacian
        together += tied
        end = cut + 3 * JOINT_COUNT
        result[:end, :end] += np.kron(together, np.eye(3))
        return result


def _near_open_end(template: HandTemplate) -> np.ndarray:
    """(V,) bool: near the border of the mesh, or of a closed mesh near the wrist joint."""
    border = boundary_vertices(template.faces)
    places = template.vertices[border] if len(border) else template.joints[:1]
    distance = np.linalg.norm(template.vertices[:, None] - places[None], axis=-1).min(axis=1)
    near: np.ndarray = distance < _WRIST
    return near


def _joint_surroundings(template: HandTemplate) -> np.ndarray:
    """(16, V) shares of the vertices around each joint, rows sum to 1: where two segments meet."""
    shares = np.zeros((JOINT_COUNT, len(template.vertices)))
    for joint, parent in enumerate(PARENTS):
        weights = template.weights[:, joint]
        meeting = weights * template.weights[:, parent] if parent >= 0 else weights
        distance = np.linalg.norm(template.vertices - template.joints[joint], axis=1)
        shares[joint] = (meeting + 1e-6) * np.exp(-0.5 * (distance / 0.01) ** 2)
    normed: np.ndarray = shares / shares.sum(axis=1, keepdims=True)
    return normed
