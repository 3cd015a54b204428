"""Poses as named angles, and the default place of an avatar.

It stands upright, in front of a camera that sees all of it. The hand turns, and not the camera,
because what a clip taught of its light holds in front of its camera: so every side is shown in a
light that frames have shown.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hwp_bench.base.errors import UsageError, did_you_mean
from hwp_bench.hands import (
    HandTemplate,
    TemplateTensors,
    anatomical_limits,
    joint_angles,
    load_template,
    pose_from_joint_angles,
    pose_hand,
)
from hwp_bench.hands.poses import finger_pose, gestures, mirrored
from hwp_bench.hands.skeleton import JOINT_NAMES, Camera, HandPose, palm_directions, unit

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
        """Return the angles of a hand model (`anny`, `mano:PATH`)."""
        return cls(load_template(source, side), load_template(source, "right"))

    def pose(self, angles: np.ndarray) -> np.ndarray:
        """Turn angles (16, 3) of any size into the hand model's pose (16, 3), rad."""
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
        shaped = {name: self._shaped(shape) for name, shape in gestures().items()}
        return {REST: self.named_pose(REST), **shaped}

    def named_pose(self, name: str) -> np.ndarray:
        """Return the angles of one named pose."""
        if name == REST:
            return np.zeros((len(JOINT_NAMES), 3))
        shapes = gestures()
        if name not in shapes:
            known = f"Known: {', '.join((REST, *shapes))}."
            raise UsageError(f"there is no pose {name[:40]!r}", field="pose", remedy=known)
        return self._shaped(shapes[name])

    def from_names(self, given: Mapping[str, float]) -> np.ndarray:
        """Return the angles of a hand at rest but for those that are named in `ANGLE_NAMES`."""
        angles = np.zeros((len(JOINT_NAMES), 3))
        for name, degrees in given.items():
            if name not in ANGLE_NAMES:
                hint = did_you_mean(name, ANGLE_NAMES) or "Use a name as 'index1 flexion'."
                raise UsageError(f"there is no angle {name[:40]!r}", field="pose", remedy=hint)
            place = divmod(ANGLE_NAMES.index(name), len(ANGLES))
            low, high = self.lower[place], self.upper[place]
            if not low <= degrees <= high:
                problem, remedy = f"{name} is {degrees:g} degrees", f"Use {low:g} to {high:g}."
                raise UsageError(problem, field="pose", remedy=remedy)
            angles[place] = degrees
        return angles

    def _shaped(self, shape: np.ndarray) -> np.ndarray:
        """The angles of an upright hand of a named shape, within the ranges."""
        fingers = finger_pose(shape, self._right.joints)
        if self.side == "left":
            fingers = mirrored(fingers)
        pose = np.concatenate([self.upright.as_rotvec()[None], fingers])
        return self.angles(pose).clip(self.lower, self.upper)


def _turn_to_upright(forward: np.ndarray, palmar: np.ndarray) -> Rotation:
    """The rotation that takes the fingers up (-y) and the palm to the camera (-z)."""
    ours = np.stack([forward, palmar, np.cross(forward, palmar)], axis=1)
    up, towards = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -1.0])
    return Rotation.from_matrix(np.stack([up, towards, np.cross(up, towards)], axis=1) @ ours.T)


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

    def posed(self, pose: Pose = REST, turn: float = 0.0) -> dict[str, HandPose]:
        """Return every hand in one pose, as it stands in the studio.

        Args:
            turn: of all of them about the vertical through their middle, degrees.
        """
        return self.posed_each(dict.fromkeys(self.angles, pose), turn)

    def posed_each(self, poses: Mapping[str, Pose], turn: float = 0.0) -> dict[str, HandPose]:
        """Return hands in a pose of their own each, by side; see `posed`."""
        turned, hands = Rotation.from_euler("y", turn, degrees=True), {}
        for side, pose in poses.items():
            vectors = _axis_angles(pose, self.angles[side]).copy()
            vectors[0] = (turned * Rotation.from_rotvec(vectors[0])).as_rotvec()
            # Rotations leave the wrist where it is, so the translation carries it around.
            wrist = self._wrists[side]
            transl = turned.apply(wrist + self._transl[side]) + self.centre - wrist
            hands[side] = HandPose(side, vectors, self._betas[side], transl)
        return hands

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera: at the origin, along z, with all of the hands in its picture."""
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
