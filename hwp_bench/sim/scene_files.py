"""Scenes that come with the package, and scene files."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.records import MAX_CHARACTERS, parse_record, parse_toml
from hwp_bench.capture.schema import check_id
from hwp_bench.sim.effects import check_hands, check_modes, read_effect
from hwp_bench.sim.props.behind import check_backdrop
from hwp_bench.sim.scene.scene import (
    CLEAN_FROM,
    MIN_CLEAN_SHARE,
    EffectCall,
    Episode,
    Scene,
    clean_share,
    with_clean_share,
)
from hwp_bench.sim.sensor import Sensor
from hwp_bench.sim.subject.subject import Words
from hwp_bench.taxonomy import MAX_SEVERITY, PERTURBATIONS

#: Largest strength of an effect; those that calibration finds stay below 2.5.
MAX_STRENGTH = 10.0

_Strength = Annotated[float, Meta(ge=0.0, le=MAX_STRENGTH)]
_SCENES = Path(__file__).with_name("scenes")


@cache
def scene_names(group: str = "") -> tuple[str, ...]:
    """Names of scenes that come with the package.

    Args:
        group: one of `scene_groups`; the eleven captures, in the catalogue's order, if empty.
    """
    names = [path.stem for path in (_SCENES / group).iterdir() if path.suffix == ".toml"]
    return tuple(sorted(names, key=lambda name: (len(name), name)))


@cache
def scene_groups() -> tuple[str, ...]:
    """Names of the groups of further scenes, each a folder of its own, such as `wild-dev`."""
    return tuple(sorted(path.name for path in _SCENES.iterdir() if path.is_dir()))


def scene_path(name: str) -> Path:
    """Path of the file of a scene that comes with the package."""
    (path,) = (*_SCENES.glob(f"{name}.toml"), *_SCENES.glob(f"*/{name}.toml"))
    return path


def known_scenes() -> tuple[str, ...]:
    """Names of all scenes that come with the package: the eleven captures, then each group's."""
    return tuple(name for group in ("", *scene_groups()) for name in scene_names(group))


def meant_scenes(names: Iterable[str]) -> tuple[str, ...]:
    """The scenes that a command means: `all` are the eleven captures, a group's name all of it.

    Other names, and paths, stay as they are.
    """
    groups = {"all": scene_names()} | {group: scene_names(group) for group in scene_groups()}
    return tuple(scene for name in names for scene in groups.get(name, (name,)))


def load_scene(name_or_path: str | Path) -> Scene:
    """Read a scene that comes with the package, or a scene file.

    Args:
        name_or_path: `capture0` to `capture10`, a scene of a group such as `wild-dev-3`, or the
            path of a TOML file.

    Raises:
        UsageError: there is no such scene.
        BadInput: the file is damaged, or a field is missing, unknown or out of range.
    """
    name = str(name_or_path)
    if name in known_scenes():
        return _shipped_scene(name)
    path = Path(name_or_path)
    if not path.is_file():
        raise UsageError(
            f"there is no scene {name!r}",
            remedy=f"Known: {', '.join(known_scenes())}; or the path of a scene file.",
        )
    try:
        with path.open(encoding="utf-8") as stream:
            text = stream.read(MAX_CHARACTERS + 1)
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput("cannot be read as text", where=path) from error
    return parse_scene(text, where=str(path))


@cache
def _shipped_scene(name: str) -> Scene:
    """Read a scene that comes with the package once: a board asks for suites thousands of times."""
    return parse_scene(scene_path(name).read_text("utf-8"), where=f"{name}.toml")


def parse_scene(text: str, *, where: str) -> Scene:
    """Make a scene of TOML text."""
    content = parse_toml(text, where=where)
    rows = {name: content.pop(name) for name in ("effects",) if name in content}
    effects = parse_record(_Effects, rows, where=where, error=BadInput)
    noise = {name: content.pop(name) for name in ("noise",) if name in content}
    scene = parse_record(Scene, content, where=where, error=BadInput)
    check_id(scene.id, where)  # It names the capture, and files of previews.
    calls = tuple(_effect(row, f"effects[{i}]", where) for i, row in enumerate(effects.effects))
    scene = replace(scene, effects=calls)
    if "sensor" not in content:
        # A scene that says no more of its sensor has the noise at its top.
        sensor = parse_record(Sensor, noise, where=where, error=BadInput)
        scene = replace(scene, sensor=sensor)
    elif noise:
        raise BadInput("is in the table sensor already", where=where, field="noise")
    check_hands(((side, side) for side in scene.track.keys), scene, "track", where)
    for side in scene.sides:
        if not scene.track.keys.get(side):
            raise BadInput("holds no key", where=where, field=f"track.{side}")
    check_backdrop(scene.background, where)
    if scene.clean_share is not None:
        try:
            scene = with_clean_share(scene, scene.clean_share)
        except UsageError as error:
            raise BadInput(
                error.problem, where=where, field=error.field, remedy=error.remedy
            ) from error
    _check_effects(scene, where)
    return scene


@dataclass(frozen=True)
class _Effects:
    """The tables `effects` of a scene file."""

    effects: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True)
class _EffectTable:
    """Fields that every table of `effects` has; the others are settings of its kind."""

    kind: Words
    episodes: Annotated[list[tuple[float, float, float]], Meta(max_length=1000)]
    strengths: tuple[_Strength, _Strength, _Strength, _Strength, _Strength] | None = None

    def __post_init__(self) -> None:
        if self.kind not in PERTURBATIONS:
            known = ", ".join(PERTURBATIONS)
            raise UsageError(f"is {self.kind!r}", field="kind", remedy=f"Known: {known}.")
        if not self.episodes:
            raise UsageError("is empty", field="episodes")
        for start, end, severity in self.episodes:
            if not 0.0 <= start < end < CLEAN_FROM:
                raise UsageError(
                    f"[{start}, {end}] does not lie in order from 0 to below {CLEAN_FROM}",
                    field="episodes",
                    remedy="The last fifth (validation and test) stays clean.",
                )
            if not 1.0 <= severity <= MAX_SEVERITY:
                raise UsageError(
                    f"severity {severity} is not in 1..{MAX_SEVERITY}", field="episodes"
                )
        parts = sorted(self.episodes)
        for before, after in itertools.pairwise(parts):
            if after[0] < before[1]:
                raise UsageError(
                    f"{list(before)} and {list(after)} overlap",
                    field="episodes",
                    remedy="Make one episode of them, or shorten one.",
                )
        values = list(self.strengths or ())
        if sorted(values) != values:
            problem = f"is {values}, expected rising numbers from 0 up"
            raise UsageError(problem, field="strengths")


def _effect(row: dict[str, Any], path: str, where: str) -> EffectCall:
    names = {item.name for item in fields(_EffectTable)}
    head = {name: value for name, value in row.items() if name in names}
    table = parse_record(_EffectTable, head, where=where, field=path, error=BadInput)
    return EffectCall(
        kind=table.kind,
        episodes=tuple(Episode(*episode) for episode in table.episodes),
        strengths=table.strengths,
        settings={name: value for name, value in row.items() if name not in names},
    )


def _check_effects(scene: Scene, where: str) -> None:
    kinds = [call.kind for call in scene.effects]
    if len(set(kinds)) != len(kinds):
        raise BadInput("an effect is called twice", where=where, field="effects")
    for call in scene.effects:
        effect = read_effect(call, where)
        check_hands(effect.named_hands(), scene, f"effects({call.kind})", where)
        check_modes(effect, call, scene, where)
    share = clean_share(scene)
    if scene.clean_share is None and share < MIN_CLEAN_SHARE:
        raise BadInput(
            f"only {share:.2%} of the training part is unperturbed, at least "
            f"{MIN_CLEAN_SHARE:.0%} must be",
            where=where,
            field="effects",
            remedy="Shorten episodes, let those of different effects overlap, or say clean_share.",
        )
