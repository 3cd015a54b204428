"""A hand's pose as named angles in degrees, with the ranges of its joints, and named poses."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hwp_bench.base.errors import UsageError, did_you_mean
from hwp_bench.hands import (
    HandTemplate,
    anatomical_limits,
    joint_angles,
    load_template,
    pose_from_joint_angles,
)
from hwp_bench.hands.poses import finger_pose, gestures, mirrored
from hwp_bench.hands.skeleton import JOINT_NAMES, palm_directions, unit

#: The three angles of a joint.
ANGLES = ("flexion", "abduction", "twist")
#: The name of every angle, joint by joint: `wrist flexion` to `thumb3 twist`.
ANGLE_NAMES = tuple(f"{joint} {angle}" for joint in JOINT_NAMES for angle in ANGLES)
#: The named pose with every angle zero.
REST = "rest"
# The wrist is free, and so is the direction of a whole hand.
_WRIST_RANGE = (180.0, 90.0, 180.0)


class HandAngles:
    """The angles of one hand model's hand.

    Angles are arrays (16, 3) in degrees: flexion, abduction and twist of the wrist and of the 15
    finger joints in MANO's order. With zeros everywhere the hand is at rest, upright, with its palm
    to a camera that looks along z where y points down.

    Args:
        template: the hand at rest.
        right: the right hand of the same model, in which the named poses are defined.

    Attributes:
        side: `right` or `left`.
        lower: (16, 3) whole degrees, the least angles; not positive.
        upper: (16, 3) whole degrees, the largest angles; not negative.
        upright: turns the hand model's rest frame so that the fingers point up.
    """

    def __init__(self, template: HandTemplate, right: HandTemplate) -> None:
        limits = anatomical_limits(template)
        self.side = template.side
        wrist = np.array([_WRIST_RANGE])
        # Ranges end inside those of the anatomy.
        self.lower = np.ceil(np.concatenate([-wrist, np.degrees(limits.lower)])) + 0.0
        self.upper = np.floor(np.concatenate([wrist, np.degrees(limits.upper)]))
        palm = palm_directions(template.joints, template.side)
        self.upright = _turn_to_upright(palm.forward, palm.palmar)
        flexion = unit(np.cross(palm.forward, palm.palmar))
        twist = palm.forward if template.side == "right" else -palm.forward
        of_wrist = np.stack([flexion, np.cross(twist, flexion), twist], axis=1)
        self._axes = torch.from_numpy(np.concatenate([of_wrist[None], limits.axes]))
        self._right = right

    @classmethod
    def of(cls, source: str, side: str) -> HandAngles:
        """Return the angles of a hand model (`anny`, `mano:PATH`).

        Raises:
            BadHandModel: its file is missing or damaged.
        """
        return cls(load_template(source, side), load_template(source, "right"))

    def pose(self, angles: np.ndarray) -> np.ndarray:
        """Turn angles into the hand model's pose.

        Args:
            angles: (16, 3) degrees, of any size.

        Returns:
            (16, 3) axis-angle, rad.
        """
        given = torch.from_numpy(np.radians(np.asarray(angles, dtype=np.float64)))
        pose = pose_from_joint_angles(given[None], self._axes)[0].numpy()
        pose[0] = (self.upright * Rotation.from_rotvec(pose[0])).as_rotvec()
        return pose

    def angles(self, pose: np.ndarray) -> np.ndarray:
        """Invert `pose`: (16, 3) degrees, which may lie outside of the ranges."""
        local = np.array(pose, dtype=np.float64)
        local[0] = (self.upright.inv() * Rotation.from_rotvec(local[0])).as_rotvec()
        # `joint_angles` leaves a first joint out.
        padded = torch.from_numpy(np.concatenate([np.zeros((1, 3)), local]))[None]
        return np.degrees(joint_angles(padded, self._axes)[0].numpy())

    def named_poses(self) -> dict[str, np.ndarray]:
        """Return the angles of every named pose: rest, and the named hand shapes.

        They lie within the ranges. The palm faces the camera in all of them.
        """
        found = {REST: np.zeros((len(JOINT_NAMES), 3))}
        for name, shape in gestures().items():
            fingers = finger_pose(shape, self._right.joints)
            if self.side == "left":
                fingers = mirrored(fingers)
            pose = np.concatenate([self.upright.as_rotvec()[None], fingers])
            found[name] = self.angles(pose).clip(self.lower, self.upper)
        return found

    def named_pose(self, name: str) -> np.ndarray:
        """Return the angles of one named pose.

        Raises:
            UsageError: there is none of this name.
        """
        poses = self.named_poses()
        if name not in poses:
            raise UsageError(
                f"there is no pose {name[:40]!r}",
                field="pose",
                remedy=f"Known: {', '.join(poses)}.",
            )
        return poses[name]

    def from_names(self, given: Mapping[str, float]) -> np.ndarray:
        """Return the angles of a hand at rest but for those that are named.

        Args:
            given: degrees by name of `ANGLE_NAMES`, as `{"index1 flexion": 60}`.

        Raises:
            UsageError: a name is unknown, or an angle is not within its range.
        """
        angles = np.zeros((len(JOINT_NAMES), 3))
        for name, degrees in given.items():
            if name not in ANGLE_NAMES:
                hint = did_you_mean(name, ANGLE_NAMES) or "Use a name as 'index1 flexion'."
                raise UsageError(f"there is no angle {name[:40]!r}", field="pose", remedy=hint)
            place = divmod(ANGLE_NAMES.index(name), len(ANGLES))
            low, high = self.lower[place], self.upper[place]
            if not low <= degrees <= high:
                raise UsageError(
                    f"{name} is {degrees:g} degrees",
                    field="pose",
                    remedy=f"Use {low:g} to {high:g}.",
                )
            angles[place] = degrees
        return angles


def _turn_to_upright(forward: np.ndarray, palmar: np.ndarray) -> Rotation:
    """The rotation that takes the fingers up (-y) and the palm to the camera (-z)."""
    ours = np.stack([forward, palmar, np.cross(forward, palmar)], axis=1)
    up, towards = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -1.0])
    return Rotation.from_matrix(np.stack([up, towards, np.cross(up, towards)], axis=1) @ ours.T)
