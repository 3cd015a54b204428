"""The scenes of a secret. Oracles: HMAC written out, and the JSON of the public scenes."""

from __future__ import annotations

import hashlib
import hmac
import json
import secrets
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.commitments.recipe import (
    RecipeScene,
    SealedRecipe,
    derived,
    derived_seed,
    read_secret,
    recipe_of,
    sealed_scene,
    secret_commitment,
    suite_recipe,
)
from hwp_bench.sim.scene_files import known_scenes, load_scene
from hwp_bench.sim.subject.hand import subject_betas

SECRETS = st.binary(min_size=32, max_size=32).map(bytes.hex)


def seeds_of(value: Any) -> list[int]:
    """Every value under a key `seed`, in order."""
    if isinstance(value, dict):
        own = [value["seed"]] if isinstance(value.get("seed"), int) else []
        return own + [seed for part in value.values() for seed in seeds_of(part)]
    if isinstance(value, list | tuple):
        return [seed for part in value for seed in seeds_of(part)]
    return []


def without_person(content: dict[str, Any]) -> Any:
    """A scene's JSON without its id, seeds, and what makes another person."""
    text = json.loads(json.dumps(content))
    for name in ("tone", "age", "sleeve"):
        del text["subject"][name]
    del text["id"]

    def stripped(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: stripped(part) for key, part in value.items() if key != "seed"}
        return [stripped(part) for part in value] if isinstance(value, list) else value

    return stripped(text)


@given(secret=SECRETS, label=st.text(max_size=20))
def test_numbers_are_those_of_hmac_sha256(secret: str, label: str) -> None:
    message = json.dumps(["hwp-secret/1", "seed", label], separators=(",", ":")).encode()
    whole = hmac.digest(bytes.fromhex(secret), message, "sha256")
    assert derived(secret, "seed", label) == whole
    assert derived_seed(secret, label) == int.from_bytes(whole[:8], "big") % 2**63


@given(secret=SECRETS)
def test_the_commitment_is_a_digest_of_secret_and_recipe(secret: str) -> None:
    recipe = asdict(recipe_of(["capture2"], 20, 64))
    text = json.dumps(
        {"recipe": recipe, "schema": "hwp-secret/1", "secret": secret},
        sort_keys=True,
        separators=(",", ":"),
    )
    found = secret_commitment(secret, recipe)
    assert found == hashlib.sha256(text.encode()).hexdigest()
    assert found != secret_commitment(secret, {**recipe, "size": 65})
    assert found != secret_commitment(secrets.token_hex(32), recipe)


@pytest.mark.parametrize("name", known_scenes())
def test_every_seed_and_the_person_are_exchanged_and_nothing_else(name: str) -> None:
    scene = load_scene(name)
    before = scene.to_json()
    first, second = (sealed_scene(scene, secret).to_json() for secret in ("11" * 32, "22" * 32))
    assert first["id"] == f"sealed-{name}"
    public, one, other = (seeds_of(content) for content in (before, first, second))
    assert len(public) == len(one) == len(other) >= 2
    # Each place has a seed of its own, in each suite.
    assert len({*public, *one, *other}) >= len({*one, *other}) + 1
    assert len({*one, *other}) == 2 * len(one)
    assert all(0 <= seed < 2**63 for seed in one)
    assert max(one) > 2**40
    assert without_person(before) == without_person(first) == without_person(second)
    assert sealed_scene(scene, "11" * 32).to_json() == first
    shapes = [subject_betas(sealed_scene(scene, s).subject) for s in ("11" * 32, "22" * 32)]
    assert np.abs(shapes[0] - shapes[1]).max() > 0.1


@settings(max_examples=20)
@given(secret=SECRETS)
def test_scenes_of_one_suite_share_no_seed(secret: str) -> None:
    items = [sealed_scene(load_scene(f"capture{k}"), secret).to_json() for k in range(3)]
    seeds = [seed for item in items for seed in seeds_of(item)]
    assert len(set(seeds)) == len(seeds)


def test_a_suite_gives_its_own_frames_and_size() -> None:
    recipe = suite_recipe("full-lite")
    assert recipe.size == 256
    assert len(recipe.scenes) == 11
    assert recipe.scenes[0].frames == 76
    assert sum(scene.frames for scene in recipe.scenes) == 1157


@pytest.mark.parametrize(
    ("names", "frames", "size", "words"),
    [
        ([], 20, 64, "0 scenes"),
        (["capture2", "capture2"], 20, 64, "twice"),
        (["capture99"], 20, 64, "capture99"),
        (["../capture2"], 20, 64, "not a scene"),
        (["capture2"], 9, 64, "--frame-count"),
        (["capture2"], 20, 31, "31 is not from 32 to 1024"),
        (["capture2"], 20, 1025, "--size"),
    ],
)
def test_recipes_that_nobody_could_check_are_refused(
    names: list[str], frames: int, size: int, words: str
) -> None:
    with pytest.raises(UsageError, match=words):
        recipe_of(names, frames, size)


def test_a_recipe_of_another_toolkit_is_named() -> None:
    scene = RecipeScene("capture2", "0" * 64, 20)
    with pytest.raises(UsageError, match="capture2 is another scene"):
        SealedRecipe((scene,), 64).refuse_other_toolkit()
    with pytest.raises(UsageError, match="renderer 1"):
        SealedRecipe((scene,), 64, renderer=1).refuse_other_toolkit()


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"schema": "hwp-secret/1", "secret": "12"}', '{"schema": "x"}']
)
def test_a_damaged_secret_is_named(tmp_path: Any, text: str) -> None:
    path = tmp_path / "secret.json"
    path.write_text(text)
    with pytest.raises(BadInput, match=r"secret\.json"):
        read_secret(path)
