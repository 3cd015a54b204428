"""Hand shapes by name, and anatomical joint angles turned into the hand model's pose."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from importlib import resources
from types import MappingProxyType

import numpy as np

from hwp_bench.base.errors import BadInput

#: Order of the fingers in an articulation.
FINGERS = ("thumb", "index", "middle", "ring", "little")
#: First joint of each finger in MANO's order.
FIRST_JOINT = MappingProxyType({"index": 1, "middle": 4, "little": 7, "ring": 10, "thumb": 13})
#: Lowest and highest angle in degrees for the thumb, then for every other finger.
LIMITS = (
    np.array([[-30.0, 70.0], [-35.0, 45.0], [-20.0, 70.0], [-25.0, 85.0]]),
    np.array([[-30.0, 95.0], [-8.0, 112.0], [-12.0, 85.0], [-25.0, 25.0]]),
)
#: How far a finger closes before it meets the palm: `CLOSING` times its three flexions, degrees,
#: at most `CLOSED`, for index, middle, ring and little finger. Solved with
#: `benchmarks.penetration` for a tip that presses 3 mm into the palm.
CLOSING = np.array([0.9, 1.0, 0.3])
CLOSED = np.array([140.0, 153.0, 150.0, 135.0])


@cache
def gestures() -> Mapping[str, np.ndarray]:
    """Return the named hand shapes: (5, 4) degrees each, rows in the order of `FINGERS`."""
    text = resources.files("hwp_bench.hands").joinpath("data", "gestures.toml").read_text("utf-8")
    return MappingProxyType(
        {
            name: np.array([shape[finger] for finger in FINGERS], dtype=np.float64)
            for name, shape in tomllib.loads(text).items()
        }
    )


def gesture(name: str) -> np.ndarray:
    """Look a hand shape up.

    Raises:
        BadInput: no shape has that name; the message lists the known ones.
    """
    try:
        return gestures()[name]
    except KeyError:
        known = ", ".join(gestures())
        raise BadInput(
            f"there is no gesture {name!r}", field="gesture", remedy=f"Known: {known}."
        ) from None


def finger_back(finger: str) -> np.ndarray:
    """Unit vector that the back of a finger faces on the right hand at rest."""
    return np.array([0.2, 0.62, 0.76]) if finger == "thumb" else np.array([0.0, 1.0, 0.0])


def within_limits(angles: np.ndarray) -> np.ndarray:
    """Clip (..., 5, 4) degrees to what a hand can do.

    A finger that would close into the palm keeps the proportions of its flexions and stops where
    it touches.
    """
    thumb = np.clip(angles[..., :1, :], LIMITS[0][:, 0], LIMITS[0][:, 1])
    rest = np.clip(angles[..., 1:, :], LIMITS[1][:, 0], LIMITS[1][:, 1])
    closing = np.maximum(rest[..., :3] @ CLOSING, 1e-9)
    rest[..., :3] *= np.minimum(1.0, CLOSED / closing)[..., None]
    return np.concatenate([thumb, rest], axis=-2)


def finger_pose(angles: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Turn anatomical angles into axis-angle vectors of the *right* hand.

    Args:
        angles: (5, 4) degrees, rows in the order of `FINGERS`, columns as `gestures.toml` says.
        joints: (16, 3) rest joints of the right hand, m.

    Returns:
        (15, 3) axis-angle rad, joints 1-15 in MANO's order. The left hand's pose is
        (x, -y, -z) of it.
    """
    from scipy.spatial.transform import Rotation

    angles = np.radians(within_limits(np.asarray(angles, dtype=np.float64)))
    pose = np.zeros((16, 3))
    for row, finger in enumerate(FINGERS):
        first = FIRST_JOINT[finger]
        bones = np.diff(joints[first : first + 3], axis=0)
        bones = np.vstack([bones, bones[-1]])
        bones /= np.linalg.norm(bones, axis=1, keepdims=True)
        axes = np.cross(finger_back(finger), bones)
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        a, b, c, d = angles[row]
        if finger == "thumb":
            base = Rotation.from_rotvec([a, 0, 0]) * Rotation.from_rotvec([0, -b, 0])
            pose[first] = base.as_rotvec()
            pose[first + 1] = axes[1] * c
            pose[first + 2] = axes[2] * d
        else:
            # About +y the finger, which points along -x, swings to the thumb's side (+z).
            base = Rotation.from_rotvec([0, d, 0]) * Rotation.from_rotvec(axes[0] * a)
            pose[first] = base.as_rotvec()
            pose[first + 1] = axes[1] * b
            pose[first + 2] = axes[2] * c
    return pose[1:]


def mirrored(pose: np.ndarray) -> np.ndarray:
    """The same pose on the other hand: (x, -y, -z), joint by joint."""
    return pose * np.array([1.0, -1.0, -1.0])
