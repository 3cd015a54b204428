"""A scene: what a simulated capture shows, as checked data.

World and camera share OpenCV axes at the start: x right, y down, z away from the camera.
Times inside a capture are fractions of it (0 = first frame, 1 = last), so that the same scene
renders at any number of frames.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any

from msgspec import Meta

from hwp_bench.base.errors import ODD_CHARACTERS, UsageError
from hwp_bench.base.files import sha256_json
from hwp_bench.base.records import Seed, number
from hwp_bench.hands.poses import gesture
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.scene.behind import NOTHING, Behind
from hwp_bench.sim.scene.lighting import Lamp, Room
from hwp_bench.sim.scene.looks import PLAIN, Looks
from hwp_bench.sim.scene.recorder import AutoControl, without_defaults
from hwp_bench.sim.scene.subject_anatomy import SubjectAnatomy
from hwp_bench.sim.scene.tracking import Estimator
from hwp_bench.taxonomy import MAX_SEVERITY

#: Version of the scene format; part of every scene digest.
SCHEMA = "hwp-scene/1"
#: Where the clean part of a capture begins, as a fraction: nothing is perturbed from here on.
CLEAN_FROM = 0.8
#: Share of the training frames that must stay unperturbed.
MIN_CLEAN_SHARE = 0.35

#: A text with at least one visible character.
Words = Annotated[
    str,
    Meta(
        pattern=rf"\A[^{ODD_CHARACTERS}]*[^\s{ODD_CHARACTERS}][^{ODD_CHARACTERS}]*\Z",
        description="a text that is not empty",
    ),
]
_Share = Annotated[float, Meta(ge=-1.0, le=1.0)]
_Brightness = Annotated[float, Meta(ge=0.0, le=20.0)]
_Axis = Annotated[float, Meta(ge=-100.0, le=100.0)]
_Metres = Annotated[float, Meta(ge=-1.0, le=1.0)]


@dataclass(frozen=True)
class Subject:
    """The person whose hands are shown."""

    #: Identity: shape parameters, surface detail, mottling.
    seed: Seed
    #: Skin tone, 0 (light) to 1 (dark); -0.4 is the palest skin and 1.4 the darkest.
    tone: Annotated[float, Meta(ge=-0.4, le=1.4)]
    #: Years; deepens creases, veins and tendons.
    age: Annotated[float, Meta(ge=5.0, le=100.0)]
    #: sRGB colour of the sleeve, 0-1 each.
    sleeve: tuple[_Share, _Share, _Share] = (0.25, 0.3, 0.4)
    #: Surface: `anny` (the free hand), `mano:PATH` or `mano-hd:PATH` where the user has it, or
    #: `gltf:PATH`, a rigged hand, or `rig:NAME`, one that comes with the package.
    model: Words = "anny"
    #: Marks on the skin and what the person wears.
    looks: Looks = PLAIN
    #: Geometry that no shape of the model has; None for the model as it is.
    anatomy: SubjectAnatomy | None = None

    def to_json(self) -> dict[str, Any]:
        """Return JSON values, without later fields that change nothing."""
        content = without_defaults(self, ("seed", "tone", "age", "sleeve", "model"))
        content.pop("looks", None)
        if looks := self.looks.to_json():
            content["looks"] = looks
        if self.anatomy is not None:
            content["anatomy"] = without_defaults(self.anatomy, ())
        return content


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
class Light:
    """A key light and the sky, constant unless an effect changes them."""

    #: Direction towards the key light, world axes; need not be normalised.
    direction: tuple[_Axis, _Axis, _Axis]
    #: Irradiance of the key light relative to white.
    key: _Brightness
    #: Radiance of the sky relative to white.
    sky: _Brightness
    #: Colour temperature of the key light, kelvin.
    kelvin: Annotated[float, Meta(ge=1500.0, le=15000.0)]
    #: Lamps and windows besides it.
    lamps: Annotated[tuple[Lamp, ...], Meta(max_length=4)] = ()
    #: Coloured walls in place of the sky, or None.
    room: Room | None = None
    #: Factor on the light that falls on the backdrop.
    backdrop: float = number(1.0, 0.0, 50.0)

    def __post_init__(self) -> None:
        if not any(self.direction):
            raise UsageError("is zero", field="direction")

    def to_json(self) -> dict[str, Any]:
        """Return JSON values, without later fields that change nothing."""
        return without_defaults(self, ("direction", "key", "sky", "kelvin"))


@dataclass(frozen=True)
class Sensor:
    """The sensor: light becomes a stored image, in the same way for a clean version."""

    #: Standard deviation of the noise at mid grey, of 1.
    noise: Annotated[float, Meta(ge=0.0, le=0.2)]
    #: Quality of the JPEG that the device stores, 1-100; 0 stores without loss.
    jpeg_quality: int = number(0, 0, 100)
    #: Rolling shutter: s from the reading of the first row to that of the last; 0 reads all at
    #: once.
    rolling_shutter: float = number(0.0, 0.0, 0.05)
    #: Strength of the unsharp mask on the brightness; 0 leaves edges as they are.
    sharpening: float = number(0.0, 0.0, 3.0)
    #: Exposure and white balance that follow the image, or None: both are fixed.
    auto: AutoControl | None = None
    #: Bits a pixel of the H.264 video that the device stores; 0 stores frame by frame. A phone's
    #: camera writes 0.1 to 0.3, a messenger 0.03 to 0.1.
    h264: float = number(0.0, 0.0, 4.0)

    def to_json(self) -> dict[str, Any]:
        """Return JSON values, without later fields that change nothing."""
        return without_defaults(self, ("noise", "jpeg_quality", "rolling_shutter"))


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


@dataclass(frozen=True)
class Track:
    """The motion of the hands: keys that repeat, varied in every round."""

    #: Length of one round, s.
    period: float
    #: Keys of each side, spread evenly over the period.
    keys: Mapping[str, tuple[HandKey, ...]]
    #: Spread of the angles between rounds, degrees; makes test poses partly unseen.
    variation: float = 6.0


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
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Scene:
    """One simulated capture."""

    #: Name of the capture.
    id: str
    #: One line for people.
    title: str
    #: `right`, `left` or `both`.
    hands: str
    #: What the hands do, as the catalogue says it.
    action: str
    #: What records it, as the catalogue says it.
    device: str
    #: Frames of the whole capture.
    frame_count: int
    #: Frames per second of the whole capture.
    fps: float
    #: Seed of everything that is random.
    seed: int
    #: Whose hands.
    subject: Subject
    #: The camera.
    camera: SceneCamera
    #: The light where no effect changes it.
    light: Light
    #: Name of a backdrop.
    background: str
    #: The sensor.
    sensor: Sensor
    #: What the hands do.
    track: Track
    #: Perturbations.
    effects: tuple[EffectCall, ...]
    #: Whose hand parameters a method gets, or None: those of a good estimator.
    estimator: Estimator | None = None
    #: What moves behind the hands.
    behind: Behind = NOTHING

    @property
    def sides(self) -> tuple[str, ...]:
        """The hands in the image, right first."""
        return sides_of(self.hands)

    @property
    def duration(self) -> float:
        """Length of the capture, s."""
        return self.frame_count / self.fps

    def to_json(self) -> dict[str, Any]:
        """Return the whole content as JSON values, laid out as a scene file is."""
        content = {"schema": SCHEMA, **asdict(self)}
        content |= {"sensor": self.sensor.to_json(), "light": self.light.to_json()}
        content["subject"] = self.subject.to_json()
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


def sides_of(hands: str) -> tuple[str, ...]:
    """The hands that `right`, `left` or `both` names, right first."""
    return ("right", "left") if hands == "both" else (hands,)


def with_severity(scene: Scene, severity: float) -> Scene:
    """The scene with every episode at one severity.

    Raises:
        UsageError: the severity is not in 1 to 5.
    """
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
    """The scene with another person: shape, tone, age and sleeve follow from the seed.

    Raises:
        UsageError: the seed is negative.
    """
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
