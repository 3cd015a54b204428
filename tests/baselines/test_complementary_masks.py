"""Two masks in turn and a moving average. Oracles: masks pixel by pixel, the average by its sum,
frames with an object before the hand."""

from __future__ import annotations

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
from painted import QUICK, TrainingMaker

from complementary_masks_fit.method import (
    ComplementaryMasksMethod,
    ComplementaryMasksRecipe,
    find_hard,
    soft_target,
)
from hwp_bench.capture import Capture
from plain_fit.method import PlainMethod
from wildghand.plain.recipe import Batch, Drawing

STEPS = {**QUICK, "steps": 150}
SETTINGS = {**STEPS, "high_share": 0.2}


def test_superpixels_with_more_than_their_share_of_high_errors_are_left_out() -> None:
    """The oracle counts by loops; random errors, two of nine superpixels of 4 x 4 px are bad."""
    random = np.random.default_rng(2)
    errors, unlike = 0.1 * random.random((2, 12, 12))
    regions = np.arange(12)[:, None] // 4 * 3 + np.arange(12) // 4
    hand = random.random((12, 12)) < 0.9
    for bad in (1, 5):
        errors[regions == bad] += 0.5
        unlike[regions == bad] += 0.5
    errors[regions == 7] += 0.5  # and nothing unlike
    found = find_hard(*(torch.from_numpy(x) for x in (errors, unlike, hand, regions)), 0.2).numpy()
    high = hand & (errors > np.quantile(errors[hand], 0.8))
    high &= unlike > np.quantile(unlike[hand], 0.6)
    for region in range(9):
        inside = hand & (regions == region)
        expected = high[inside].mean() <= high[hand].mean()
        assert (found[inside] == expected).all(), region
    assert found[~hand].all()
    assert not found[hand & np.isin(regions, (1, 5))].any()
    assert found[hand & (regions == 7)].all()


def test_a_frame_without_a_hand_is_kept_whole() -> None:
    empty = torch.zeros(4, 4)
    regions = torch.zeros(4, 4, dtype=torch.int64)
    assert find_hard(empty, empty, empty > 0.0, regions, 0.2).all()
    assert (soft_target(empty, empty > 0.0) == 1.0).all()


def test_the_soft_mask_learns_one_at_the_most_alike_pixel_and_zero_at_the_least() -> None:
    unlike = torch.tensor([[0.1, 0.3, 9.0], [0.2, 0.5, -9.0]])
    hand = torch.tensor([[True, True, False], [True, True, False]])
    expected = torch.tensor([[1.0, 0.5, 1.0], [0.75, 0.0, 1.0]])
    torch.testing.assert_close(soft_target(unlike, hand), expected, atol=1e-6, rtol=0.0)


def recipe_of(make_training: TrainingMaker, **settings: object) -> ComplementaryMasksRecipe:
    training = with_an_object(make_training())
    settings = {**SETTINGS, **settings}
    method = ComplementaryMasksMethod(settings)
    return ComplementaryMasksRecipe(material_of(training), method.settings)


def test_the_teacher_is_the_moving_average(make_training: TrainingMaker) -> None:
    """Oracle: 0.5^n of the start and 0.5^(n - i + 1) of each step i, in float64; 1e-5."""
    recipe = recipe_of(make_training, teacher_decay=0.5)
    states, batches = [recipe.model.snapshot().parameters()], recipe.batches()
    for step in range(4):
        recipe.step(next(batches), step / 4)
        states.append(recipe.model.snapshot().parameters())
    shares = [0.5**4, 0.5**4, 0.5**3, 0.5**2, 0.5]
    for name, average in recipe.teacher.parameters().items():
        expected = sum(
            share * state[name].double() for share, state in zip(shares, states, strict=True)
        )
        torch.testing.assert_close(average.double(), expected, atol=1e-5, rtol=0.0)


def test_consistency_is_the_mean_difference_to_what_the_teacher_draws(
    make_training: TrainingMaker,
) -> None:
    """None before the warm-up; then 0.7 times the difference of two renderings."""
    recipe = recipe_of(make_training, consistency=0.7, warm_up=0.5)
    recipe.teacher.gaussians.logit_colors.add_(1.0)
    for fraction, share in ((0.4, 0.0), (0.6, 0.7)):
        batch = batch_of(recipe.material, 3, fraction=fraction)
        with torch.no_grad():
            drawing = recipe.draw(batch)
            weights = torch.zeros_like(batch.masks)
            mine, recipe.model = recipe.model, recipe.teacher
            other = recipe.draw(batch)
            recipe.model = mine
            expected = share * float((drawing.image - other.image).abs().mean())
            assert float(recipe.loss(batch, drawing, weights)) == pytest.approx(expected, rel=1e-5)


def masks_of(recipe: ComplementaryMasksRecipe, step: int) -> Callable[[Batch], torch.Tensor]:
    def judge(batch: Batch) -> torch.Tensor:
        frame = Batch(step, 0.0, batch.rows, batch.images, batch.masks)
        with torch.no_grad():
            drawing: Drawing = recipe.draw(frame)
            return recipe.weights(frame, drawing)

    return judge


def test_both_masks_fall_on_the_object_and_are_not_the_same(make_training: TrainingMaker) -> None:
    """After 150 steps the hard mask leaves out at least nine tenths of the object, the soft one
    holds it below 0.7 of its weight, and both leave the rest at 0.9 or more."""
    recipe = recipe_of(make_training)
    fit_parts(recipe, 150)
    training = recipe.material.training
    hard = share_of_object(training, recipe, masks_of(recipe, 1))
    soft = share_of_object(training, recipe, masks_of(recipe, 0))
    assert hard[0] < 0.1, hard
    assert 0.1 < soft[0] < 0.7, soft
    assert min(hard[1], soft[1]) > 0.9, (hard, soft)


def test_an_object_before_the_hand_is_left_out(
    make_training: TrainingMaker, make_painted: Callable[[str], Capture]
) -> None:
    """It costs the plain fit some 3.5 dB; 1 dB must come back."""
    training = with_an_object(make_training())
    methods = PlainMethod(STEPS, 0), ComplementaryMasksMethod(SETTINGS, 0)
    plain, ours = scores_of(training, make_painted("right"), *methods)
    assert ours > plain + 1.0, (plain, ours)
