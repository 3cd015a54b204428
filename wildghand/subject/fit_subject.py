"""The subject's own hand: the template bent until its outlines meet those of the masks.

Posed points are linear in the rest surface and the rest joints, so each round is one linear least
squares problem: outlines are drawn, every point of them is asked to move by its gap to the mask's
outline, and control points, joints and the frames' translations share what is asked. Gaps that
nothing smooth explains (an object in front, a blurred border, a wrong mask) count less and less.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.linalg import solve

from hwp_bench.capture import Cameras
from hwp_bench.hands import HandParameters, HandTemplate
from hwp_bench.hands.skeleton import PARENTS
from hwp_bench.hands.template import JOINT_COUNT
from wildghand.subject.compared_frames import ComparedFrames, PosedFrames
from wildghand.subject.control_points import ControlPoints, place_control_points
from wildghand.subject.linear_hand import joint_turns, vertex_turns
from wildghand.subject.outlines import OutlinePoints
from wildghand.subject.settings import SubjectSettings
from wildghand.subject.shape import SubjectShape, side_flip

#: Factors on the expected error of an outline among which frames that are not fitted choose, from
#: the stiffest hand to the softest.
STIFFNESS = (4.0, 2.0, 1.0, 0.5)
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
    *,
    judges: ComparedFrames | None = None,
) -> SubjectShape:
    """Fit a person's hand to masks; deterministic.

    Args:
        templates: by side.
        hands: parameters of every frame, by side.
        cameras: of every frame.
        frames: (R,) numbers of the frames with masks, ascending.
        masks: (R, H, W) uint8, 255 = visible hand.
        settings: how.
        judges: frames that are not fitted, which choose how far the hand bends; None: the
            settings do.

    Returns:
        The shape; zeros where too little can be compared.
    """
    picks = np.unique(np.linspace(0, len(frames) - 1, settings.frames).round().astype(int))
    seen = ComparedFrames(templates, hands, cameras, frames[picks], masks[picks] > 127)
    problem = _Problem(seen, settings)
    shape = problem.bend(1.0) if judges is None else _judged(problem, judges, settings)
    # An avatar keeps float32: it is drawn with what is read again.
    return SubjectShape(
        shape.vertices.astype(np.float32).astype(np.float64),
        shape.joints.astype(np.float32).astype(np.float64),
    )


def _judged(problem: _Problem, judges: ComparedFrames, settings: SubjectSettings) -> SubjectShape:
    """The stiffest hand whose outlines meet those of other frames almost as well as any does."""
    before = judges.misfit(problem.shape, settings.reach)
    if before is None:
        return problem.bend(1.0)
    shapes, misfits = [problem.shape], [before]
    for factor in STIFFNESS:
        shape = problem.bend(factor) if len(shapes) == 1 else problem.bend_further(factor)
        misfit = judges.misfit(shape, settings.reach)
        if misfit is None or misfit >= misfits[-1]:
            break
        shapes.append(shape)
        misfits.append(misfit)
    enough = misfits[-1] + settings.least_gain * before
    return next(shape for shape, one in zip(shapes, misfits, strict=True) if one <= enough)


class _Problem:
    """The frames that are compared, and the linear problem of one round."""

    def __init__(self, seen: ComparedFrames, settings: SubjectSettings) -> None:
        self.seen, self.settings = seen, settings
        first = next(iter(seen.templates.values()))
        self.points: ControlPoints = place_control_points(first, settings.nodes)
        self.ring = _joint_surroundings(first)
        self.expected = self._expected()
        self.values = np.zeros(self._size())
        #: So far.
        self.shape = SubjectShape(np.zeros_like(first.vertices), np.zeros((JOINT_COUNT, 3)))
        # (S, F, 3) m, added to the given translations so far.
        self._moves = np.zeros((len(seen.templates), len(seen), 3))

    def _size(self) -> int:
        moves = 3 * len(self.seen.templates) * len(self.seen)
        return 3 * (self.points.shares.shape[1] + JOINT_COUNT) + moves

    def bend(self, factor: float) -> SubjectShape:
        """Bend the template; the reach falls round by round.

        Args:
            factor: on the expected error of the outlines.

        Returns:
            The shape; the one before where too little can be compared.
        """
        settings = self.settings
        for fraction in np.linspace(0.0, 1.0, settings.rounds):
            reach = settings.reach * _FIRST_REACH ** (1.0 - fraction)
            if not self._solve(reach, factor * settings.noise):
                break
        return self.shape

    def bend_further(self, factor: float) -> SubjectShape:
        """Bend a hand whose outlines are near the masks': one round with the last reach is enough.

        Arguments and result are those of `bend`.
        """
        self._solve(self.settings.reach, factor * self.settings.noise)
        return self.shape

    def _solve(self, reach: float, noise: float) -> bool:
        """One round: the numbers that explain the gaps of the outlines best.

        Args:
            reach: gap at which a point counts a quarter, px.
            noise: expected error of a point, px.

        Returns:
            Whether enough can be compared.
        """
        rows, gaps = [], []
        posed = self.seen.posed(self.shape, self._moves)
        quota = max(20, self.settings.points // len(self.seen))
        for frame in range(len(self.seen)):
            seen = self.seen.compare(posed, frame, quota)
            if len(seen.gap):
                rows.append(self._rows(seen, posed, frame))
                gaps.append(seen.gap)
        if not rows or sum(map(len, gaps)) < _LEAST:
            return False
        matrix, gap = np.concatenate(rows), np.concatenate(gaps)
        weight = 1.0 / (1.0 + (gap / reach) ** 2) ** 2 / noise**2
        # The unknowns are the whole displacement, so that each round regularises all of it.
        target = gap + matrix @ self.values
        right = matrix.T @ (weight * target)
        matrix *= np.sqrt(weight).astype(np.float32)[:, None]
        normal = (matrix.T @ matrix).astype(np.float64) + self.expected
        self.values = solve(normal, right, assume_a="pos")
        nodes, joints, self._moves = self._parts(self.values)
        self.shape = SubjectShape(self.points.shares @ nodes, joints)
        return True

    def _parts(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Control points (K, 3), joints (16, 3) and translations (S, F, 3)."""
        cut = 3 * self.points.shares.shape[1]
        nodes, joints = values[:cut].reshape(-1, 3), values[cut : cut + 3 * JOINT_COUNT]
        moves = values[cut + 3 * JOINT_COUNT :].reshape(len(self.seen.templates), -1, 3)
        return nodes, joints.reshape(-1, 3), moves

    def _rows(self, seen: OutlinePoints, posed: PosedFrames, frame: int) -> np.ndarray:
        """Rows of the linear problem of the M points of one frame, (M, size) float32."""
        viewmat, K = self.seen.viewmats[frame], self.seen.Ks[frame]
        at = self.seen.faces[seen.face]
        place = np.einsum("mc,mck->mk", seen.mix, posed.meshes[frame][at])
        # px along the outward direction for each metre of the point, (M, 3).
        camera = place @ viewmat[:3, :3].T + viewmat[:3, 3]
        away = camera[:, 2:]
        focal = seen.outward * [K[0, 0], K[1, 1]]
        slope = np.concatenate(
            [focal / away, -(focal * camera[:, :2]).sum(axis=1, keepdims=True) / away**2], axis=1
        )
        slope = slope @ viewmat[:3, :3]
        result = np.zeros((len(at), self._size()), dtype=np.float32)
        self._fill(result, at, seen.mix, slope, [turns[frame] for turns in posed.turns], frame)
        return result

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
        for index, (side, template) in enumerate(self.seen.templates.items()):
            mine = np.flatnonzero(at[:, 0] // self.seen.count == index)
            if not len(mine):
                continue
            corner, flip = at[mine] - index * self.seen.count, side_flip(side)
            used, where = np.unique(corner, return_inverse=True)
            where = where.reshape(corner.shape)
            moved = vertex_turns(turns[index], template.weights[used])[where]
            steps = (slope[mine, None, None] @ moved)[:, :, 0] * flip
            shares = mix[mine, :, None] * self.points.shares[used][where]
            result[mine, :cut] = (shares.transpose(0, 2, 1) @ steps).reshape(len(mine), -1)
            bones = joint_turns(turns[index], template.weights[used]).reshape(len(used), -1)
            bones = np.einsum("mc,mcx->mx", mix[mine], bones[where])
            step = np.einsum("mi,mjik->mjk", slope[mine], bones.reshape(-1, JOINT_COUNT, 3, 3))
            result[mine, cut : cut + 3 * JOINT_COUNT] = (step * flip).reshape(len(mine), -1)
            start = cut + 3 * JOINT_COUNT + 3 * (index * len(self.seen) + frame)
            result[mine, start : start + 3] = slope[mine]

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
