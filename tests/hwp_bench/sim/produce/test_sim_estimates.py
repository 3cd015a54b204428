"""Errors of masks where the background looks like skin.

Oracles: the mask without them, bit for bit, where nothing can be confused; disc-shaped hands on
backgrounds of their own and of another colour.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from tiny_scene import SceneMaker

from hwp_bench.sim.effects import plan_frame
from hwp_bench.sim.produce.estimates import confusable, confused_mask, estimate_mask, likeness
from hwp_bench.sim.props.behind import Behind, Face
from hwp_bench.sim.scene.scene import Scene
from hwp_bench.sim.subject.subject import Looks

SIZE = 96
SKIN, GREEN = np.array([205, 150, 120]), np.array([60, 120, 70])


@pytest.fixture
def coverage() -> np.ndarray:
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    return np.clip(26.0 - np.hypot(y - 50, x - 46) + 0.5, 0.0, 1.0)


def picture(coverage: np.ndarray, background: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(3).normal(0.0, 4.0, (SIZE, SIZE, 3))
    mixed = coverage[..., None] * SKIN + (1.0 - coverage[..., None]) * background
    return np.clip(mixed + noise, 0, 255).astype(np.uint8)


def masks(scene: Scene, coverage: np.ndarray, background: np.ndarray) -> list[np.ndarray]:
    """The confused masks of twelve frames."""
    rgb = picture(coverage, background)
    recipes = [plan_frame(scene, number, 40, SIZE) for number in range(26, 38)]
    return [
        confused_mask(scene, item, estimate_mask(scene, item, coverage, coverage), coverage, rgb)
        for item in recipes
    ]


def overlap(mask: np.ndarray, coverage: np.ndarray) -> float:
    taken, hand = mask > 127, coverage > 0.5
    return float((taken & hand).sum() / (taken | hand).sum())


def test_masks_of_other_scenes_stay_as_they_are(
    make_scene: SceneMaker, coverage: np.ndarray
) -> None:
    scene = make_scene()
    assert not confusable(scene)
    recipe = plan_frame(scene, 36, 40, SIZE)
    mask = estimate_mask(scene, recipe, coverage, coverage)
    assert confused_mask(scene, recipe, mask, coverage, picture(coverage, SKIN)) is mask


def test_what_can_be_confused(make_scene: SceneMaker) -> None:
    scene = make_scene()
    assert confusable(replace(scene, background="wood"))
    assert confusable(replace(scene, behind=Behind(face=Face())))
    assert confusable(replace(scene, subject=replace(scene.subject, looks=Looks(arm="bare"))))


def test_masks_err_where_the_background_looks_like_skin_and_only_there(
    make_scene: SceneMaker, coverage: np.ndarray
) -> None:
    scene = replace(make_scene(), background="wood")
    plain = replace(scene, background="studio")
    usual = np.mean([overlap(mask, coverage) for mask in masks(plain, coverage, SKIN)])
    unlike = np.mean([overlap(mask, coverage) for mask in masks(scene, coverage, GREEN)])
    alike = np.mean([overlap(mask, coverage) for mask in masks(scene, coverage, SKIN * 0.97)])
    assert unlike == pytest.approx(usual, abs=0.01)
    assert 0.6 < alike < usual - 0.03


def test_errors_wander_and_repeat(make_scene: SceneMaker, coverage: np.ndarray) -> None:
    scene = replace(make_scene(), background="sand")
    first, again = masks(scene, coverage, SKIN), masks(scene, coverage, SKIN)
    np.testing.assert_array_equal(first, again)
    near = np.mean([overlap(a, b / 255.0) for a, b in pairwise(first)])
    far = np.mean([overlap(a, b / 255.0) for a, b in zip(first, first[8:], strict=False)])
    assert far < near < 1.0
    other = masks(replace(scene, seed=scene.seed + 1), coverage, SKIN)
    assert overlap(first[0], other[0] / 255.0) < 1.0


def test_likeness_tells_skin_from_another_colour(coverage: np.ndarray) -> None:
    half = np.where(np.arange(SIZE)[None, :, None] < SIZE // 2, SKIN, GREEN)
    alike = likeness(picture(coverage, half), coverage)
    free = coverage == 0.0
    assert alike[:, : SIZE // 2 - 4][free[:, : SIZE // 2 - 4]].mean() > 0.8
    assert alike[:, SIZE // 2 + 4 :][free[:, SIZE // 2 + 4 :]].mean() < 0.02


def test_a_frame_without_a_hand_keeps_its_mask(make_scene: SceneMaker) -> None:
    scene = replace(make_scene(), background="wood")
    recipe = plan_frame(scene, 36, 40, SIZE)
    empty = np.zeros((SIZE, SIZE))
    mask = np.zeros((SIZE, SIZE), dtype=np.uint8)
    assert confused_mask(scene, recipe, mask, empty, picture(empty, SKIN)) is mask
