"""A scene at any time: how strongly effects act, the hands of its track, and its camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hwp_bench.hands.poses import finger_pose, gesture, mirrored, within_limits
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.light.lights import focus_point
from hwp_bench.sim.scene.scene import CLEAN_FROM, EffectCall, HandKey, Scene
from hwp_bench.sim.subject.hand import FINE, SubjectHand, subject_hand

#: Share of an episode in which it rises, and in which it falls.
RAMP = 0.2
#: A level below this rounds to severity 0: the effect is absent.
ACTIVE_FROM = 0.5
# Moments at which the share of clean frames is measured.
_PROBES = 2001


def level(call: EffectCall, moment: float) -> float:
    """How strongly an effect acts at one moment: 0, or from `ACTIVE_FROM` to 5."""
    strongest = 0.0
    for episode in call.episodes:
        if episode.start <= moment <= episode.end:
            through = (moment - episode.start) / (episode.end - episode.start)
            rise = min(through, 1.0 - through) / RAMP
            shape = min(1.0, 0.35 + 0.65 * rise)
            strongest = max(strongest, shape * episode.severity)
    return strongest if strongest >= ACTIVE_FROM else 0.0


def envelope(call: EffectCall, moment: float) -> float:
    """How far into an episode a moment is: 0 at its ends, 1 from `RAMP` on, smooth between."""
    for episode in call.episodes:
        if episode.start <= moment <= episode.end:
            through = (moment - episode.start) / (episode.end - episode.start)
            x = min(1.0, min(through, 1.0 - through) / RAMP)
            return x * x * (3.0 - 2.0 * x)
    return 0.0


def severity(call: EffectCall, moment: float) -> int:
    """Severity that is written into the capture: the level rounded to an integer, 0-5."""
    return int(np.floor(level(call, moment) + 0.5))


def moments(frame_count: int) -> np.ndarray:
    """Moment of every frame as a fraction of the capture: (F,) in [0, 1)."""
    return np.arange(frame_count) / frame_count


def clean_share(scene: Scene) -> float:
    """Share of the training part in which no effect acts."""
    probes = np.linspace(0.0, CLEAN_FROM, _PROBES)
    acting = [any(level(call, moment) for call in scene.effects) for moment in probes]
    return 1.0 - float(np.mean(acting))


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
    """State of a repeating row of keys at `phase` (one key per unit), varied in every round."""
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
    """One hand of the undisturbed track at a time."""
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

    Takes `joints` (16, 3) m.
    """
    return 0.35 * joints[0] + 0.65 * joints[4]


def hand_parameters(
    moment: HandMoment, side: str, joints: np.ndarray, focus: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Turn a moment into the hand model's pose and translation.

    Takes `joints` (16, 3) rest joints of that side with the subject's shape, `focus` (3,) the point
    that places are relative to. Returns pose (16, 3) axis-angle rad and transl (3,) m.
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


def scene_hands(scene: Scene, subdivisions: int = FINE) -> dict[str, SubjectHand]:
    """The subject's hands that a scene shows, by side."""
    return {side: subject_hand(scene.subject, side, subdivisions) for side in scene.sides}


def intrinsics(scene: Scene, size: int) -> np.ndarray:
    """(3, 3) K in pixels of a square image."""
    focal = 0.5 * size / np.tan(np.radians(scene.camera.field_of_view) / 2.0)
    return np.array([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])


def viewmat(scene: Scene, seconds: float) -> np.ndarray:
    """(4, 4) world to camera; a camera that stands still has the identity."""
    if not scene.camera.handheld:
        return np.eye(4)
    from scipy.spatial.transform import Rotation

    rng = generator(scene.seed, "camera")
    rates = rng.uniform(0.4, 2.2, (2, 6))
    phases = rng.uniform(0.0, 2.0 * np.pi, (2, 6))
    waves = np.sin(rates * seconds + phases)
    waves = 0.7 * waves[0] + 0.3 * waves[1]
    view = np.eye(4)
    view[:3, :3] = Rotation.from_rotvec(0.012 * waves[:3]).as_matrix()
    # The camera sways around the point that it looks at.
    focus = focus_point()
    view[:3, 3] = focus - view[:3, :3] @ focus - scene.camera.sway * waves[3:]
    return view


def pixel_rays(
    K: np.ndarray,
    view: np.ndarray,
    box: tuple[int, int, int, int],
    grid: int,
    shift: tuple[float, float] = (0.0, 0.0),
) -> tuple[np.ndarray, np.ndarray]:
    """Rays through a regular grid inside every pixel.

    Takes `K` (3, 3) px, `view` (4, 4) world to camera. Returns origin (3,) m and directions (rows *
    grid, columns * grid, 3), world, with length 1 along the camera's axis.
    """
    top, bottom, left, right = box
    across = left + (np.arange((right - left) * grid) + 0.5 + shift[0]) / grid
    down = top + (np.arange((bottom - top) * grid) + 0.5 + shift[1]) / grid
    x, y = np.meshgrid((across - K[0, 2]) / K[0, 0], (down - K[1, 2]) / K[1, 1])
    in_camera = np.stack([x, y, np.ones_like(x)], axis=-1)
    turn = view[:3, :3]
    return -turn.T @ view[:3, 3], in_camera @ turn


def parameters_of(
    scene: Scene,
    moments: Sequence[Mapping[str, HandMoment]],
    betas: Mapping[str, np.ndarray] | None = None,
) -> dict[str, HandParameters]:
    """Hand parameters of every frame, by side, with these betas (10,) or the true ones."""
    found = {}
    for side, subject in scene_hands(scene).items():
        shape, joints = subject.betas, subject.model_joints
        if betas is not None:
            shape = betas[side]
            joints = subject.model.joints + subject.model.joint_basis @ shape
        rows = [hand_parameters(hands[side], side, joints, focus_point()) for hands in moments]
        found[side] = HandParameters(
            pose=np.stack([pose for pose, _ in rows]),
            betas=shape,
            transl=np.stack([transl for _, transl in rows]),
            valid=np.ones(len(moments), dtype=bool),
        )
    return found
