"""The hands at any time: the key track of a scene, and its conversion to hand parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hwp_bench.hands.poses import finger_pose, gesture, mirrored, within_limits
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.scene.schema import HandKey, Scene

# Share of the way from key to key in which the hand rests at the key.
_DWELL = 0.3
# Slow wander on top of the keys: metres, and degrees of turn, tilt and roll.
_WANDER_PLACE = 0.006
_WANDER_ANGLE = 3.0


@dataclass(frozen=True)
class HandMoment:
    """One hand at one instant, in anatomical terms."""

    #: (5, 4) degrees, as in `gestures.toml`.
    angles: np.ndarray
    #: (3,) m, centre of the palm in the world relative to the point looked at.
    place: np.ndarray
    #: (3,) degrees: turn, tilt, roll, as in `HandKey`.
    heading: np.ndarray

    def blend(self, other: HandMoment, weight: float) -> HandMoment:
        """Return the moment `weight` of the way to another."""
        return HandMoment(
            angles=self.angles + weight * (other.angles - self.angles),
            place=self.place + weight * (other.place - self.place),
            heading=self.heading + weight * (other.heading - self.heading),
        )


def moment_of_key(key: HandKey) -> HandMoment:
    """Return the moment that a key describes."""
    return HandMoment(
        angles=gesture(key.gesture),
        place=np.array(key.place),
        heading=np.array([key.turn, key.tilt, key.roll]),
    )


def smoothstep(x: float) -> float:
    """Ease from 0 to 1 with zero speed and acceleration at both ends (6x^5 - 15x^4 + 10x^3)."""
    x = min(max(x, 0.0), 1.0)
    return x * x * x * (x * (6.0 * x - 15.0) + 10.0)


def along_keys(
    keys: list[HandMoment], phase: float, scene: Scene, label: str, variation: float
) -> HandMoment:
    """State of a repeating row of keys at `phase` (one key per unit), varied in every round.

    Args:
        keys: the row.
        phase: 0 at the first key; grows without end.
        scene: whose seed the variation follows.
        label: names the row, so that two rows vary independently.
        variation: standard deviation of the angles, degrees.
    """
    index = int(np.floor(phase))
    before = _varied(keys[index % len(keys)], scene, label, index, variation)
    after = _varied(keys[(index + 1) % len(keys)], scene, label, index + 1, variation)
    through = (phase - index - _DWELL / 2) / (1.0 - _DWELL)
    return before.blend(after, smoothstep(through))


def _varied(key: HandMoment, scene: Scene, label: str, index: int, variation: float) -> HandMoment:
    rng = generator(scene.seed, "key", label, index)
    angles = key.angles + rng.normal(0.0, variation, key.angles.shape)
    return replace(
        key,
        angles=angles,
        place=key.place + rng.normal(0.0, 0.004, 3),
        heading=key.heading + rng.normal(0.0, variation, 3),
    )


def track_moment(scene: Scene, side: str, seconds: float) -> HandMoment:
    """One hand of the undisturbed track at a time.

    Args:
        scene: the scene.
        side: `right` or `left`.
        seconds: time since the first frame.
    """
    keys = [moment_of_key(key) for key in scene.track.keys[side]]
    phase = seconds / scene.track.period * len(keys)
    moment = along_keys(keys, phase, scene, side, scene.track.variation)
    rng = generator(scene.seed, "wander", side)
    rates = rng.uniform(0.5, 1.4, 6)
    waves = np.sin(rates * seconds * 2.0 + rng.uniform(0.0, 2.0 * np.pi, 6))
    return replace(
        moment,
        angles=within_limits(moment.angles),
        place=moment.place + _WANDER_PLACE * waves[:3],
        heading=moment.heading + _WANDER_ANGLE * waves[3:],
    )


def heading_matrix(heading: np.ndarray, side: str) -> np.ndarray:
    """Rotation from the template's rest frame to the world: (3, 3).

    At zero heading the fingers point up and the back of the hand faces the camera.
    """
    from scipy.spatial.transform import Rotation

    mirror = 1.0 if side == "right" else -1.0
    # Columns: where rest x, y, z go. Right: fingers -x to -y, back +y to -z (to the camera).
    base = np.array([[0.0, 0.0, -mirror], [mirror, 0.0, 0.0], [0.0, -1.0, 0.0]])
    turn, tilt, roll = heading
    rotation = Rotation.from_euler("yxz", [mirror * turn, -tilt, roll], degrees=True)
    return rotation.as_matrix() @ base


def palm_of(joints: np.ndarray) -> np.ndarray:
    """The middle of the palm of a hand at rest, which keys place: (3,) m.

    Args:
        joints: (16, 3) m.
    """
    return 0.35 * joints[0] + 0.65 * joints[4]


def hand_parameters(
    moment: HandMoment, side: str, joints: np.ndarray, focus: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Turn a moment into the hand model's pose and translation.

    Args:
        moment: the hand.
        side: `right` or `left`.
        joints: (16, 3) rest joints of that side with the subject's shape, m.
        focus: (3,) the point that places are relative to, world, m.

    Returns:
        pose (16, 3) axis-angle rad and transl (3,) m.
    """
    from scipy.spatial.transform import Rotation

    right_joints = joints if side == "right" else joints * np.array([-1.0, 1.0, 1.0])
    fingers = finger_pose(moment.angles, right_joints)
    if side == "left":
        fingers = mirrored(fingers)
    turn = heading_matrix(moment.heading, side)
    palm = palm_of(joints)
    transl = focus + moment.place - joints[0] - turn @ (palm - joints[0])
    return np.vstack([Rotation.from_matrix(turn).as_rotvec(), fingers]), transl
