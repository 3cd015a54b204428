"""The unknowns of a person's hand, in one vector, and how large each is expected to be.

In this order: displacements of control points, displacements of joints, proportions, and a
translation of each hand in each frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.hands import HandTemplate
from hwp_bench.hands.skeleton import JOINT_COUNT, PARENTS
from wildghand.subject.control_points import ControlPoints, place_control_points
from wildghand.subject.proportions import Proportions, hand_proportions
from wildghand.subject.settings import SubjectSettings
from wildghand.subject.shape import SubjectShape


@dataclass(frozen=True, eq=False)
class Unknowns:
    """The numbers that are sought of a person whose hands are seen in some frames."""

    #: On the rest hand.
    points: ControlPoints
    #: Of the rest hand.
    proportions: Proportions
    #: (16, V) shares of the vertices around each joint.
    surroundings: np.ndarray
    #: S, of the hands.
    hands: int
    #: F, of the frames.
    frames: int

    @classmethod
    def of(cls, template: HandTemplate, nodes: int, hands: int, frames: int) -> Unknowns:
        """The unknowns of a template's person.

        Args:
            template: of either side.
            nodes: number of control points.
            hands: one or two.
            frames: that are compared.
        """
        return cls(
            place_control_points(template, nodes),
            hand_proportions(template),
            _joint_surroundings(template),
            hands,
            frames,
        )

    @property
    def cuts(self) -> tuple[int, int, int]:
        """Where the control points, the joints and the proportions end."""
        nodes = 3 * self.points.shares.shape[1]
        joints = nodes + 3 * JOINT_COUNT
        return nodes, joints, joints + len(self.proportions.lengths)

    def __len__(self) -> int:
        return self.cuts[2] + 3 * self.hands * self.frames

    def shape(self, values: np.ndarray) -> SubjectShape:
        """The person's hand."""
        nodes, joints, proportions, _ = np.split(values, self.cuts)
        return SubjectShape(
            self.points.shares @ nodes.reshape(-1, 3) + self.proportions.vertices @ proportions,
            joints.reshape(-1, 3) + self.proportions.joints @ proportions,
        )

    def moves(self, values: np.ndarray) -> np.ndarray:
        """(S, F, 3) m, added to the given translations of the hands."""
        return values[self.cuts[2] :].reshape(self.hands, self.frames, 3)

    def expected(self, settings: SubjectSettings) -> np.ndarray:
        """(N, N) inverse covariance of the unknowns before anything is seen.

        Args:
            settings: how large each is expected to be.
        """
        points, size, (cut, end, proportions) = self.points, len(self), self.cuts
        count = points.shares.shape[1]
        result = np.zeros((size, size))
        diagonal = np.full(size, 1.0 / settings.transl_spread**2)
        diagonal[:cut] = 1.0 / settings.spread**2
        diagonal[cut:end] = 0.0
        spreads = np.where(
            self.proportions.lengths, settings.length_spread, settings.thickness_spread
        )
        diagonal[end:proportions] = 1.0 / spreads**2
        result[np.arange(size), np.arange(size)] = diagonal
        first, second = points.pairs.T
        rough = 0.01 / (points.lengths * settings.roughness**2)
        together = np.zeros((count + JOINT_COUNT,) * 2)
        np.add.at(together, (first, first), rough)
        np.add.at(together, (second, second), rough)
        np.add.at(together, (first, second), -rough)
        np.add.at(together, (second, first), -rough)
        # Joints go where the surface around them goes.
        around = self.surroundings @ points.shares
        tie = np.concatenate([around, -np.eye(JOINT_COUNT)], axis=1)
        together += tie.T @ tie / settings.joint_spread**2
        together[count, count] += 1e12  # the wrist
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
