"""The recipe of a sealed suite: public scenes, and a secret that exchanges seeds and people.

Every number is HMAC-SHA256 under the secret, of a label that says what the number is for. So no
number reveals another one or the secret (RFC 2104; as the expand step of HKDF, RFC 5869).
"""

from __future__ import annotations

import hashlib
import hmac
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Annotated, Any

from msgspec import Meta

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.files import canonical_json, read_json, write_json
from hwp_bench.base.records import MAX_SEED, Digest, Line, Record, parse_record, without_schema
from hwp_bench.sim.produce.capture import FRAMES, RENDERER, SIZES, SuiteItem, suite
from hwp_bench.sim.scene.scene import Scene, with_subject
from hwp_bench.sim.scene_files import known_scenes, load_scene

#: Version of the secret's file, and of everything that is derived.
SECRET_SCHEMA = "hwp-secret/1"
#: Length of a secret in bytes.
SECRET_BYTES = 32
# Most bytes of a secret, a page or a reveal.
_MAX_FILE = 1_000_000


@dataclass(frozen=True)
class _RecipeFile:
    """The content of a secret's file: 32 bytes in hexadecimal digits."""

    secret: Digest


def write_secret(path: str | os.PathLike[str], secret: str) -> None:
    """Write a secret to a file that only its owner may read."""
    previous = os.umask(0o077)
    try:
        write_json(path, {"schema": SECRET_SCHEMA, "secret": secret}).chmod(0o600)
    finally:
        os.umask(previous)


def read_secret(path: str | os.PathLike[str]) -> str:
    """Return the secret (hex) of a file."""
    return read_strictly(path, SECRET_SCHEMA, _RecipeFile).secret


def read_strictly(path: str | os.PathLike[str], schema: str, kind: type[Record]) -> Record:
    """Read a small JSON file of a stated schema, with no field besides the record's."""
    value = read_json(path, max_bytes=_MAX_FILE)
    value = without_schema(value, schema, where=path, error=BadInput)
    return parse_record(kind, value, where=path, error=BadInput)


def derived(secret: str, *purpose: str) -> bytes:
    """Return the 32 bytes that a secret gives for one purpose."""
    message = canonical_json([SECRET_SCHEMA, *purpose]).encode()
    return hmac.new(bytes.fromhex(secret), message, hashlib.sha256).digest()


def derived_seed(secret: str, *purpose: str) -> int:
    """Return the seed of 63 bits that a secret gives for one purpose.

    With fewer bits all seeds could be tried: a person's shape, which methods get, follows from one
    of them in microseconds.
    """
    return int.from_bytes(derived(secret, "seed", *purpose)[:8], "big") & MAX_SEED


def secret_commitment(secret: str, recipe: Mapping[str, Any]) -> str:
    """Return the SHA-256 (hex) that binds an organiser to a secret and a recipe.

    The secret has 256 random bits, so the digest reveals nothing about it.
    """
    text = canonical_json({"schema": SECRET_SCHEMA, "secret": secret, "recipe": dict(recipe)})
    return hashlib.sha256(text.encode()).hexdigest()


#: Most captures of a suite.
MAX_CAPTURES = 200
#: Begin of the ids of sealed captures: nobody takes them for the public ones.
PREFIX = "sealed-"


@dataclass(frozen=True)
class RecipeScene:
    """One public scene of a recipe."""

    #: Name of a scene that comes with the package.
    name: Line
    #: Digest of the scene as it is public.
    digest: Digest
    #: Frames over which it is spread.
    frames: Annotated[int, Meta(ge=FRAMES[0], le=FRAMES[1])]


@dataclass(frozen=True)
class SealedRecipe:
    """Everything but the secret that decides the captures of a sealed suite."""

    #: Its scenes, each once.
    scenes: Annotated[tuple[RecipeScene, ...], Meta(min_length=1, max_length=MAX_CAPTURES)]
    size: Annotated[int, Meta(ge=SIZES[0], le=SIZES[1])]
    renderer: Annotated[int, Meta(ge=1, le=10**6)] = RENDERER

    def __post_init__(self) -> None:
        names = [scene.name for scene in self.scenes]
        if len(set(names)) < len(names):
            raise UsageError("names a scene twice", field="scenes")
        unknown = sorted(set(names) - set(known_scenes()))
        if unknown:
            raise UsageError(
                f"{unknown[0]!r} is not a scene that comes with the toolkit",
                field="scenes",
                remedy="Those who check a suite must have its scenes: `hwp-bench list scenes`.",
            )

    def refuse_other_toolkit(self) -> None:
        """Refuse a recipe that this version of the toolkit does not render as its maker's did."""
        remedy = "Install the version of the toolkit that made the suite."
        if self.renderer != RENDERER:
            raise UsageError(
                f"was rendered by renderer {self.renderer}, and this one is {RENDERER}",
                field="renderer",
                remedy=remedy,
            )
        for scene in self.scenes:
            if load_scene(scene.name).digest != scene.digest:
                raise UsageError(f"{scene.name} is another scene", field="scenes", remedy=remedy)


def recipe_of(names: Sequence[str], frames: int, size: int) -> SealedRecipe:
    """Make a recipe of scenes that come with the package."""
    for flag, value, (low, high) in (("--frame-count", frames, FRAMES), ("--size", size, SIZES)):
        if not low <= value <= high:
            raise UsageError(f"{value} is not from {low} to {high}", field=flag)
    if not 1 <= len(names) <= MAX_CAPTURES:
        raise UsageError(f"{len(names)} scenes are not from 1 to {MAX_CAPTURES}", field="SCENE")
    known = set(known_scenes())
    digests = {name: load_scene(name).digest if name in known else "" for name in names}
    return SealedRecipe(tuple(RecipeScene(name, digests[name], frames) for name in names), size)


def suite_recipe(name: str) -> SealedRecipe:
    """Make a recipe of the scenes, frames and size of a suite."""
    items = suite(name)
    rows = [RecipeScene(one.scene.id, one.scene.digest, one.frame_count) for one in items]
    return SealedRecipe(tuple(rows), items[0].size)


def sealed_items(recipe: SealedRecipe, secret: str) -> tuple[SuiteItem, ...]:
    """Return the captures of a recipe under a secret, in the recipe's order."""
    return tuple(
        SuiteItem(sealed_scene(load_scene(row.name), secret), row.frames, recipe.size)
        for row in recipe.scenes
    )


def sealed_scene(scene: Scene, secret: str) -> Scene:
    """Return a scene with another person and other seeds throughout.

    Shape, skin, tone, age and sleeve, the variation of poses, paths of camera and objects' swings,
    noise, and everything else that is drawn follow from the secret. Gestures, light, perturbations
    and their times are the public scene's, and so are marks, gloves and proportions of a person,
    drawn again where they have a seed.
    """
    label = (scene.id, "person")
    person = with_subject(scene, derived_seed(secret, *label)).subject
    person = replace(person, looks=scene.subject.looks)
    changed = replace(scene, subject=person, id=PREFIX + scene.id)
    reseeded: Scene = _with_seeds(changed, secret, (scene.id,))
    return reseeded


def _with_seeds(value: Any, secret: str, place: tuple[str, ...]) -> Any:
    """Return a value in which every field `seed`, however deep, is derived from its place."""
    if is_dataclass(value) and not isinstance(value, type):
        changes = {}
        for field in fields(value):
            old = getattr(value, field.name)
            if field.name == "seed" and isinstance(old, int):
                changes["seed"] = derived_seed(secret, *place, "seed")
            elif (new := _with_seeds(old, secret, (*place, field.name))) is not old:
                changes[field.name] = new
        return replace(value, **changes) if changes else value
    if isinstance(value, tuple):
        items = tuple(_with_seeds(v, secret, (*place, str(i))) for i, v in enumerate(value))
        return items if any(a is not b for a, b in zip(items, value, strict=True)) else value
    if isinstance(value, Mapping):
        table = {
            key: derived_seed(secret, *place, "seed")
            if key == "seed" and isinstance(old, int)
            else _with_seeds(old, secret, (*place, str(key)))
            for key, old in value.items()
        }
        return table if any(table[key] is not value[key] for key in value) else value
    return value
