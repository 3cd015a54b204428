"""Reading scenes: those that come with the package, and scene files."""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.sim.props.backdrop import check_backdrop
from hwp_bench.sim.scene.effect_settings import check_settings, hand_key
from hwp_bench.sim.scene.episodes import clean_share
from hwp_bench.sim.scene.fields import Fields
from hwp_bench.sim.scene.schema import (
    CLEAN_FROM,
    MIN_CLEAN_SHARE,
    Camera,
    EffectCall,
    Episode,
    Light,
    Scene,
    Sensor,
    Subject,
    Track,
)
from hwp_bench.taxonomy import MAX_SEVERITY, PERTURBATIONS

_SCENES = Path(__file__).with_name("scenes")


@cache
def scene_names() -> tuple[str, ...]:
    """Names of the scenes that come with the package, in the catalogue's order."""
    names = [path.stem for path in _SCENES.iterdir() if path.suffix == ".toml"]
    return tuple(sorted(names, key=lambda name: (len(name), name)))


def scene_path(name: str) -> Path:
    """Path of the file of a scene that comes with the package."""
    return _SCENES / f"{name}.toml"


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
        return parse_scene(scene_path(name).read_text("utf-8"), where=f"{name}.toml")
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
    check_backdrop(scene.background, where)
    kinds = [call.kind for call in scene.effects]
    if len(set(kinds)) != len(kinds):
        raise BadInput("an effect is called twice", where=where, field="effects")
    for call in scene.effects:
        check_settings(scene, call, where)
    share = clean_share(scene)
    if share < MIN_CLEAN_SHARE:
        raise BadInput(
            f"only {share:.0%} of the training part is unperturbed, at least "
            f"{MIN_CLEAN_SHARE:.0%} must be",
            where=where,
            field="effects",
            remedy="Shorten episodes or let those of different effects overlap.",
        )
