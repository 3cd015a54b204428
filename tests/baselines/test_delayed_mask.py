"""A mask that is held towards static at first. Oracles: the published schedule, box means by a
loop, frames with an object before the hand."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from fitted_parts import (
    batch_of,
    fit_parts,
    material_of,
    scores_of,
    share_of_object,
    with_an_object,
)
from painted import QUICK, SilentReport, TrainingMaker

from delayed_mask_fit.method import (
    SHAPE,
    DelayedMaskMethod,
    DelayedMaskRecipe,
    box_mean,
    static_pull,
)
from hwp_bench.capture import Capture
from hwp_bench.methods.contract import Budget
from plain_fit.method import PlainMethod
from wildghand.plain.recipe import Batch

SETTINGS = {**QUICK, "steps": 150}


@pytest.mark.parametrize("step", [0, 500, 2_000, 20_000])
def test_the_pull_falls_as_published(step: int) -> None:
    """exp(-i / 2000) at step i of 30,000, times the mean of 1 - M; tolerance: rounding."""
    chance = torch.tensor([1.0, 0.5, 0.0])
    expected = 0.5 * math.exp(-step / 2_000)
    assert float(static_pull(chance, step / 30_000, 1 / 15)) == pytest.approx(expected, rel=1e-6)
    assert float(static_pull(chance, step / 30_000, 0.0)) == 0.0


def test_coarse_images_are_means_over_squares() -> None:
    """Outside of the image is black. Tolerance: float32 sums of 25 values."""
    image = torch.rand(1, 8, 7, 3, generator=torch.Generator().manual_seed(1))
    made, padded = box_mean(image, 5)[0], np.pad(image[0].numpy(), ((2, 2), (2, 2), (0, 0)))
    for y, x in ((0, 0), (4, 3), (7, 6)):
        expected = padded[y : y + 5, x : x + 5].mean(axis=(0, 1))
        np.testing.assert_allclose(made[y, x].numpy(), expected, atol=1e-6)


def recipe_of(make_training: TrainingMaker, **settings: object) -> DelayedMaskRecipe:
    training = with_an_object(make_training())
    settings = {**SETTINGS, **settings}
    return DelayedMaskRecipe(material_of(training), DelayedMaskMethod(settings).settings)


def test_before_its_share_of_the_fit_nothing_is_left_out_or_learnt(
    make_training: TrainingMaker,
) -> None:
    """A network that takes all for transient acts from `mask_from` on, by its margin."""
    recipe = recipe_of(make_training, mask_from=0.3, margin=2)
    recipe.network.tensors["mask.out_bias"].fill_(-50.0)
    for fraction, kept in ((0.2, True), (0.4, False)):
        batch = batch_of(recipe.material, 0, fraction=fraction)
        with torch.no_grad():
            drawing = recipe.draw(batch)
            weights = recipe.weights(batch, drawing)
        hand = batch.masks > 0.5
        assert bool((weights[hand] > 0.0).all()) is kept
        assert bool((weights[hand] == 0.0).all()) is not kept
        grown = torch.nn.functional.max_pool2d(hand[:, None].float(), 5, 1, 2)[:, 0] > 0.0
        assert bool((weights[grown] == 0.0).all()) is not kept


def test_a_mask_that_begins_late_is_no_divergence(make_training: TrainingMaker) -> None:
    """Two windows of steps pass before the network's loss joins; the fit takes all its steps."""
    settings = {**SETTINGS, "mask_from": 0.7, "validated": False}
    fit = DelayedMaskMethod(settings, 0).fit(make_training(), Budget(), SilentReport())
    assert fit.steps == settings["steps"]


def test_shapes_wait_and_the_network_does_not_slow_down(make_training: TrainingMaker) -> None:
    recipe = recipe_of(make_training, shape_from=0.5)
    for name in recipe.parameters():
        early, late = recipe.rate(name, 0.4), recipe.rate(name, 0.6)
        if name in SHAPE:
            assert early == 0.0 < late, name
        elif name in recipe.network.tensors:
            assert early == late == recipe.settings.mask_rate, name
        else:
            assert early > late > 0.0, name


def test_the_mask_falls_on_the_object(make_training: TrainingMaker) -> None:
    """After 150 steps the object is transient and nine tenths of the hand are static.

    With a pull that does not fall within the fit, nothing is transient by then.
    """
    for release, transient in ((1 / 15, True), (100.0, False)):
        recipe = recipe_of(make_training, release=release, pull=2.0 if not transient else 0.5)
        fit_parts(recipe, 150)

        def chances(batch: Batch, recipe: DelayedMaskRecipe = recipe) -> torch.Tensor:
            hand, found = batch.masks > 0.5, torch.zeros_like(batch.masks)
            found[hand] = recipe.network.chances(batch, hand).detach()
            return found

        board, rest = share_of_object(recipe.material.training, recipe, chances)
        assert rest > 0.9
        assert (board < 0.1) is transient, (board, rest)


def test_an_object_before_the_hand_is_left_out(
    make_training: TrainingMaker, make_painted: Callable[[str], Capture]
) -> None:
    """It costs the plain fit some 3.5 dB; 1.5 dB must come back."""
    training = with_an_object(make_training())
    methods = PlainMethod(SETTINGS, 0), DelayedMaskMethod(SETTINGS, 0)
    plain, ours = scores_of(training, make_painted("right"), *methods)
    assert ours > plain + 1.5, (plain, ours)
