"""A scene: what a simulated capture shows, as checked data.

World and camera share OpenCV axes at the start: x right, y down, z away from the camera.
Times inside a capture are fractions of it (0 = first frame, 1 = last), so that the same scene
renders at any number of frames.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import MISSING, asdict, dataclass, field, fields, replace
from typing import Annotated, Any, Literal

from msgspec import Meta

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import sha256_json
from hwp_bench.base.records import Seed, number
from hwp_bench.hands.poses import gesture
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.light.lights import Light
from hwp_bench.sim.props.behind import NOTHING, Behind
from hwp_bench.sim.sensor import NOISELESS, Sensor
from hwp_bench.sim.subject.subject import Subject, Words
from hwp_bench.taxonomy import MAX_SEVERITY

#: Version of the scene format; part of every scene digest.
SCHEMA = "hwp-scene/1"
#: Where the clean part of a capture begins, as a fraction: nothing is perturbed from here on.
CLEAN_FROM = 0.8
#: Share of the training frames that must stay unperturbed.
MIN_CLEAN_SHARE = 0.35

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
        content["subject"] = _subject_json(self.subject)
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
        if self.sensor == Sensor(self.sensor.noise):
            content["noise"] = content.pop("sensor")["noise"]
        return content

    @property
    def digest(self) -> str:
        """SHA-256 of the content; two scenes with the same digest render the same pixels."""
        return sha256_json(self.to_json())

    def effect(self, kind: str) -> EffectCall | None:
        """Return the call of one effect, or None."""
        return next((call for call in self.effects if call.kind == kind), None)


def with_severity(scene: Scene, severity: float) -> Scene:
    """The scene with every episode at one severity."""
    if not 1 <= severity <= MAX_SEVERITY:
        raise UsageError(f"{severity} is not in 1..{MAX_SEVERITY}", field="severity")
    effects = tuple(
        replace(
            call,
            episodes=tuple(replace(part, severity=float(severity)) for part in call.episodes),
        )
        for call in scene.effects
    )
    return replace(scene, effects=effects)


def with_subject(scene: Scene, seed: int) -> Scene:
    """The scene with another person: shape, tone, age and sleeve follow from the seed."""
    if seed < 0:
        raise UsageError(f"{seed} is not a seed", field="subject")
    rng = generator(seed, "person")
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
    return replace(scene, effects=tuple(call for call in scene.effects if call.kind in kinds))


def without_defaults(record: Any, keep: tuple[str, ...]) -> dict[str, Any]:
    """Return a record as JSON values, without fields that say what they say by default."""
    content = asdict(record)
    for item in fields(record):
        default = item.default
        if default is MISSING and item.default_factory is not MISSING:
            default = item.default_factory()
        if item.name not in keep and getattr(record, item.name) == default:
            del content[item.name]
    return content


def _subject_json(subject: Subject) -> dict[str, Any]:
    """A subject as JSON values, without later fields that change nothing."""
    content = without_defaults(subject, ("seed", "tone", "age", "sleeve", "model"))
    content.pop("looks", None)
    if looks := subject.looks.to_json():
        content["looks"] = looks
    if subject.anatomy is not None:
        content["anatomy"] = without_defaults(subject.anatomy, ())
    return content
