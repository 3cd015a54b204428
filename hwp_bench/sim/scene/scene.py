"""A scene: what a simulated capture shows, as checked data, and its state at any time.

World and camera share OpenCV axes at the start: x right, y down, z away from the camera.
Times inside a capture are fractions of it (0 = first frame, 1 = last), so that the same scene
renders at any number of frames.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import sha256_json
from hwp_bench.base.records import Seed, number, whole_seed
from hwp_bench.hands.poses import finger_pose, gesture, mirrored, within_limits
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.geometry.surface import ease, rigid
from hwp_bench.sim.light.lights import Light, focus_point
from hwp_bench.sim.props.behind import NOTHING, Behind
from hwp_bench.sim.sensor import NOISELESS, Sensor
from hwp_bench.sim.subject.hand import FINE, SubjectHand, subject_hand
from hwp_bench.sim.subject.subject import Subject, Words, without_defaults
from hwp_bench.taxonomy import MAX_SEVERITY

#: Version of the scene format; part of every scene digest.
SCHEMA = "hwp-scene/1"
#: Share of an episode in which it rises, and in which it falls.
RAMP = 0.2
#: Where the clean part of a capture begins, as a fraction: nothing is perturbed from here on.
CLEAN_FROM = 0.8
#: Share of the training part that must stay unperturbed where a scene does not say `clean_share`.
MIN_CLEAN_SHARE = 0.35
#: Most of the training part that `clean_share` leaves unperturbed.
MAX_CLEAN_SHARE = 0.9

_Metres = Annotated[float, Meta(ge=-1.0, le=1.0)]


@dataclass(frozen=True)
class SceneCamera:
    """The camera."""

    #: Held in a hand (sways and drifts) or standing still.
    handheld: bool
    #: Horizontal and vertical field of view, degrees.
    field_of_view: Annotated[float, Meta(ge=5.0, le=100.0)]
    #: Amplitude of the sway of a handheld camera, m.
    sway: float = number(0.004, 0.0, 0.05)


@dataclass(frozen=True)
class HandKey:
    """One hand at one moment of the track."""

    #: Name in `gestures.toml`.
    gesture: Words
    #: Centre of the hand, m, relative to the point that the camera looks at.
    place: tuple[_Metres, _Metres, _Metres] = (0.0, 0.0, 0.0)
    #: About the fingers' direction, degrees: 0 shows the back of the hand, 180 the palm.
    turn: float = number(0.0, -360.0, 360.0)
    #: Fingers away from the camera (positive) or towards it, degrees.
    tilt: float = number(0.0, -90.0, 90.0)
    #: In the image plane, degrees, clockwise; 0 points the fingers up.
    roll: float = number(0.0, -180.0, 180.0)

    def __post_init__(self) -> None:
        gesture(self.gesture)


def by_side(table: Any) -> dict[str, Any]:
    """The fields `right` and `left` of a table, where they are not None, right first."""
    both = {"right": table.right, "left": table.left}
    return {side: found for side, found in both.items() if found is not None}


@dataclass(frozen=True)
class Track:
    """The motion of the hands: keys that repeat, varied in every round."""

    #: Length of one round, s.
    period: Annotated[float, Meta(ge=0.2, le=600.0)]
    #: Keys of the right hand, spread evenly over the period.
    right: tuple[HandKey, ...] | None = None
    #: Keys of the left hand.
    left: tuple[HandKey, ...] | None = None
    #: Spread of the angles between rounds, degrees; makes test poses partly unseen.
    variation: float = number(6.0, 0.0, 30.0)

    @property
    def keys(self) -> dict[str, tuple[HandKey, ...]]:
        """The keys of each hand that has any, right first."""
        return by_side(self)


@dataclass(frozen=True)
class Estimator:
    """Errors of a landmark tracker and the fit to its landmarks, on top of those of the effects."""

    #: `tracker`: errors as measured on real landmarks.
    kind: Literal["tracker"]
    #: Factor on all of its errors; 1 is what was measured.
    scale: float = number(1.0, 0.0, 5.0)
    #: Chance of a gross failure in a frame. None was seen in 621 frames; (0 + 1) / (621 + 2).
    failures: float = number(0.0016, 0.0, 0.5)


@dataclass(frozen=True)
class Episode:
    """A stretch of a capture in which an effect acts."""

    #: First moment, fraction of the capture.
    start: float
    #: Last moment, fraction of the capture.
    end: float
    #: Severity in its middle, 1-5; it rises and falls at the ends.
    severity: float

    @property
    def span(self) -> tuple[float, float]:
        """First and last moment."""
        return self.start, self.end

    def rise(self, moment: float) -> float | None:
        """How far a moment lies inside of the nearer end, in lengths of `RAMP`; None outside."""
        if not self.start <= moment <= self.end:
            return None
        through = (moment - self.start) / (self.end - self.start)
        return min(through, 1.0 - through) / RAMP


@dataclass(frozen=True)
class EffectCall:
    """An effect that the scene calls for."""

    #: Name of a registered effect.
    kind: str
    #: When it acts.
    episodes: tuple[Episode, ...]
    #: Calibrated strengths at severity 1 to 5, or None for the effect's own.
    strengths: tuple[float, ...] | None = None
    #: Settings of this effect; each effect checks its own.
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Scene:
    """One simulated capture. All but `effects` is read as a scene file has it."""

    #: Name of the capture.
    id: Words
    #: One line for people.
    title: Words
    #: The hands that are shown.
    hands: Literal["right", "left", "both"]
    #: What the hands do, as the catalogue says it.
    action: Words
    #: What records it, as the catalogue says it.
    device: Words
    #: Frames of the whole capture.
    frame_count: Annotated[int, Meta(ge=10, le=100_000)]
    #: Frames per second of the whole capture.
    fps: Annotated[float, Meta(ge=1.0, le=240.0)]
    #: Seed of everything that is random.
    seed: Seed
    #: Whose hands.
    subject: Subject
    #: The camera.
    camera: SceneCamera
    #: The light where no effect changes it.
    light: Light
    #: Name of a backdrop.
    background: Words
    #: What the hands do.
    track: Track
    #: The sensor.
    sensor: Sensor = NOISELESS
    #: Perturbations.
    effects: tuple[EffectCall, ...] = ()
    #: Whose hand parameters a method gets, or None: those of a good estimator.
    estimator: Estimator | None = None
    #: What moves behind the hands.
    behind: Behind = NOTHING
    #: Share of the training part in which no effect acts, 0 to 0.9: episodes are stretched or
    #: shortened until it is so (`with_clean_share`). None: they are as written, and at least 35 %
    #: must be clean.
    clean_share: Annotated[float, Meta(ge=0.0, le=MAX_CLEAN_SHARE)] | None = None

    @property
    def sides(self) -> tuple[str, ...]:
        """The hands in the image, right first."""
        return ("right", "left") if self.hands == "both" else (self.hands,)

    @property
    def duration(self) -> float:
        """Length of the capture, s."""
        return self.frame_count / self.fps

    def to_json(self) -> dict[str, Any]:
        """Return the whole content as JSON values, laid out as a scene file is."""
        content = {"schema": SCHEMA, **asdict(self)}
        content["sensor"] = without_defaults(
            self.sensor, ("noise", "jpeg_quality", "rolling_shutter")
        )
        content["light"] = without_defaults(self.light, ("direction", "key", "sky", "kelvin"))
        subject = self.subject
        content["subject"] = without_defaults(subject, ("seed", "tone", "age", "sleeve", "model"))
        content["subject"].pop("looks", None)
        if looks := without_defaults(subject.looks):
            content["subject"]["looks"] = looks
        if subject.anatomy is not None:
            content["subject"]["anatomy"] = without_defaults(subject.anatomy)
        track = content["track"]
        content["track"] = {
            "period": track["period"],
            "keys": {side: track[side] for side in self.track.keys},
            "variation": track["variation"],
        }
        if self.estimator is None:
            del content["estimator"]
        if self.behind == NOTHING:
            del content["behind"]
        if self.clean_share is None:
            del content["clean_share"]
        if self.sensor == Sensor(self.sensor.noise):
            content["noise"] = content.pop("sensor")["noise"]
        return content

    @property
    def digest(self) -> str:
        """SHA-256 of the content; two with the same digest and model files give the same pixels."""
        return sha256_json(self.to_json())

    def effect(self, kind: str) -> EffectCall | None:
        """Return the call of one effect, or None."""
        return next((call for call in self.effects if call.kind == kind), None)


def with_severity(scene: Scene, severity: float) -> Scene:
    """The scene with every episode at one severity."""
    if not 1 <= severity <= MAX_SEVERITY:
        raise UsageError(f"{severity} is not in 1..{MAX_SEVERITY}", field="severity")
    effects = []
    for call in scene.effects:
        episodes = tuple(replace(part, severity=float(severity)) for part in call.episodes)
        effects.append(replace(call, episodes=episodes))
    return _as_stated(replace(scene, effects=tuple(effects)))


def with_subject(scene: Scene, seed: int) -> Scene:
    """The scene with another person: shape, tone, age and sleeve follow from the seed."""
    rng = generator(whole_seed(seed, "subject"), "person")
    red, green, blue = (round(float(channel), 3) for channel in rng.uniform(0.12, 0.8, 3))
    person = Subject(
        seed=seed,
        tone=round(float(rng.uniform(0.0, 1.0)), 3),
        age=round(float(rng.uniform(18.0, 75.0)), 1),
        sleeve=(red, green, blue),
        model=scene.subject.model,
        anatomy=scene.subject.anatomy,
    )
    return replace(scene, subject=person)


def with_effects(scene: Scene, kinds: Collection[str]) -> Scene:
    """The scene with only some of its effects."""
    kept = tuple(call for call in scene.effects if call.kind in kinds)
    return _as_stated(replace(scene, effects=kept))


# How far the share may be off that was asked for: ends of mild episodes round to severity 0.
_SHARE_SLACK = 0.01


def _as_stated(scene: Scene) -> Scene:
    """The scene, which states its clean share only where that is true."""
    stated = scene.clean_share
    if stated is None or abs(clean_share(scene) - stated) <= _SHARE_SLACK:
        return scene
    return replace(scene, clean_share=None)


def with_clean_share(scene: Scene, share: float) -> Scene:
    """The scene with another share of its training part unperturbed.

    Time is stretched piecewise: every stretch without an effect by one factor, every other one by
    another, so that episodes keep their order, their overlaps and their severities.

    Args:
        share: 0 (an effect acts in every training frame) to `MAX_CLEAN_SHARE`.

    Raises:
        UsageError: the share is out of range, or the episodes cannot be brought to it.
    """
    if not 0.0 <= share <= MAX_CLEAN_SHARE:
        raise UsageError(f"{share} is not in 0..{MAX_CLEAN_SHARE}", field="clean_share")
    ends = sorted({end for call in scene.effects for part in call.episodes for end in part.span})
    knots = np.unique([0.0, *ends, CLEAN_FROM])
    middles = 0.5 * (knots[1:] + knots[:-1])
    acting = np.array(
        [
            any(part.start < at < part.end for call in scene.effects for part in call.episodes)
            for at in middles
        ]
    )
    # A rest after the last episode, in a scene without a clean frame, does not count.
    lengths = np.where(np.diff(knots) < 1e-5, 0.0, np.diff(knots))
    found_clean = bool(lengths[~acting].any())
    wanted = CLEAN_FROM * np.where(acting, 1.0 - share * found_clean, share)
    totals = np.where(acting, lengths[acting].sum(), lengths[~acting].sum())
    # Without a clean stretch there is nothing to lengthen: the check below says so.
    stretched = np.divide(lengths * wanted, totals, out=np.zeros_like(lengths), where=totals > 0.0)
    # An episode acts in its last moment too, and the first one of the clean part is not its.
    places = np.minimum(np.round(np.cumsum([0.0, *stretched]), 9), CLEAN_FROM - 1e-6)
    moved = dict(zip(knots.tolist(), places.tolist(), strict=True))
    effects = tuple(
        replace(
            call,
            episodes=tuple(
                replace(part, start=moved[part.start], end=moved[part.end])
                for part in call.episodes
            ),
        )
        for call in scene.effects
    )
    found = replace(scene, effects=effects, clean_share=share)
    if abs(clean_share(found) - share) > _SHARE_SLACK:
        raise UsageError(
            f"the episodes leave {clean_share(found):.0%} of the training part unperturbed "
            f"instead of {share:.0%}",
            field="clean_share",
            remedy="Give the scene episodes of a severity from 1.5 on, with gaps between them.",
        )
    return found


#: A level below this rounds to severity 0: the effect is absent.
ACTIVE_FROM = 0.5
# Moments at which the share of clean frames is measured.
_PROBES = 2001


def level(call: EffectCall, moment: float) -> float:
    """How strongly an effect acts at one moment: 0, or from `ACTIVE_FROM` to 5."""
    rises = ((part.rise(moment), part.severity) for part in call.episodes)
    levels = (min(1.0, 0.35 + 0.65 * rise) * most for rise, most in rises if rise is not None)
    strongest = max(levels, default=0.0)
    return strongest if strongest >= ACTIVE_FROM else 0.0


def envelope(call: EffectCall, moment: float) -> float:
    """How far into an episode a moment is: 0 at its ends, 1 from `RAMP` on, smooth between."""
    rises = (part.rise(moment) for part in call.episodes)
    return float(ease(next((rise for rise in rises if rise is not None), 0.0)))


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


def along_keys(
    keys: list[HandMoment], phase: float, scene: Scene, label: str, variation: float
) -> HandMoment:
    """State of a repeating row of keys at `phase` (one key per unit), varied in every round."""
    index = int(np.floor(phase))
    before = _varied(keys[index % len(keys)], scene, label, index, variation)
    after = _varied(keys[(index + 1) % len(keys)], scene, label, index + 1, variation)
    x = min(max((phase - index - _DWELL / 2) / (1.0 - _DWELL), 0.0), 1.0)
    # Zero speed and acceleration at both ends: 6x^5 - 15x^4 + 10x^3.
    return before.blend(after, x * x * x * (x * (6.0 * x - 15.0) + 10.0))


def _varied(key: HandMoment, scene: Scene, label: str, index: int, variation: float) -> HandMoment:
    rng = generator(scene.seed, "key", label, index)
    angles = key.angles + rng.normal(0.0, variation, key.angles.shape)
    place = key.place + rng.normal(0.0, 0.004, 3)
    return HandMoment(angles, place, key.heading + rng.normal(0.0, variation, 3))


def track_moment(scene: Scene, side: str, seconds: float) -> HandMoment:
    """One hand of the undisturbed track at a time."""
    keys = [moment_of_key(key) for key in scene.track.keys[side]]
    phase = seconds / scene.track.period * len(keys)
    moment = along_keys(keys, phase, scene, side, scene.track.variation)
    rng = generator(scene.seed, "wander", side)
    rates = rng.uniform(0.5, 1.4, 6)
    waves = np.sin(rates * seconds * 2.0 + rng.uniform(0.0, 2.0 * np.pi, 6))
    return HandMoment(
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
    """The middle of the palm of a hand at rest, which keys place: (3,) m."""
    return 0.35 * joints[0] + 0.65 * joints[4]


def hand_parameters(
    moment: HandMoment, side: str, joints: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Turn a moment into the hand model's pose, (16, 3) axis-angle rad, and translation, (3,) m.

    Takes `joints` (16, 3) rest joints of that side with the subject's shape.
    """
    from scipy.spatial.transform import Rotation

    right_joints = joints if side == "right" else joints * np.array([-1.0, 1.0, 1.0])
    fingers = finger_pose(moment.angles, right_joints)
    if side == "left":
        fingers = mirrored(fingers)
    turn = heading_matrix(moment.heading, side)
    palm = palm_of(joints)
    transl = focus_point() + moment.place - joints[0] - turn @ (palm - joints[0])
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
    turn, focus = Rotation.from_rotvec(0.012 * waves[:3]).as_matrix(), focus_point()
    # The camera sways around the point that it looks at.
    return rigid(turn, focus - turn @ focus - scene.camera.sway * waves[3:])


def pixel_rays(
    K: np.ndarray,
    view: np.ndarray,
    box: tuple[int, int, int, int],
    grid: int,
    shift: tuple[float, float] = (0.0, 0.0),
) -> tuple[np.ndarray, np.ndarray]:
    """Rays through a regular grid inside every pixel: origin (3,) and directions, world.

    Directions (rows * grid, columns * grid, 3) have length 1 along the camera's axis.
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
        rows = [hand_parameters(hands[side], side, joints) for hands in moments]
        pose, transl = (np.stack(parts) for parts in zip(*rows, strict=True))
        found[side] = HandParameters(pose, shape, transl, np.ones(len(moments), dtype=bool))
    return found
