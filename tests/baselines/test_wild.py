"""Appearance and uncertainty of frames. Oracles: torch's distributions in float64, layers by hand,
frames under another light."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from fitted_parts import batch_of, material_of, scores_of
from painted import QUICK, SilentReport, TrainingMaker
from torch.distributions import Laplace, Normal

from hwp_bench.capture import Capture
from hwp_bench.methods.contract import Budget, TrainingCapture
from plain_fit.method import PlainMethod
from wild_fit.method import (
    OCTAVES,
    WildMethod,
    WildRecipe,
    after_drawing,
    appear,
    before_drawing,
    certain,
    gauss_loss,
    laplace_loss,
    places_at_rest,
    start_appearance,
)

LEAST = 0.1


def spread(low: float, high: float) -> torch.Tensor:
    return torch.linspace(low, high, 41, dtype=torch.float64)


def test_both_losses_are_likelihoods_without_their_constant() -> None:
    """Tolerance: rounding of float64."""
    error, sigma = spread(0.0, 2.0)[:, None], spread(LEAST, 3.0)[None]
    laplace = -Laplace(0.0, sigma).log_prob(error) - math.log(2.0 * LEAST)
    torch.testing.assert_close(laplace_loss(error, sigma, LEAST), laplace)
    normal = -Normal(0.0, sigma).log_prob(error) - math.log(math.sqrt(2.0 * math.pi) * LEAST)
    torch.testing.assert_close(gauss_loss(error.square(), sigma, LEAST), normal)


def test_the_best_uncertainty_is_the_error() -> None:
    sigma = spread(LEAST, 4.1)
    for error in (0.5, 1.1, 2.0):
        for loss in (
            laplace_loss(torch.tensor(error), sigma, LEAST),
            gauss_loss(torch.tensor(error) ** 2, sigma, LEAST),
        ):
            assert float(sigma[loss.argmin()]) == pytest.approx(error, abs=0.051)
            assert float(loss.min()) > 0.0


def test_pixels_are_kept_below_the_root_of_a_half() -> None:
    assert certain(torch.tensor([0.70, 0.7072])).tolist() == [True, False]


def test_only_the_uncertainty_itself_gets_its_gradient() -> None:
    """A product stands for drawing: the second factor for the geometry."""
    value = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    geometry = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    drawn = after_drawing(before_drawing(value) * geometry)
    assert drawn.item() == pytest.approx(0.35, abs=0.0, rel=1e-15)
    drawn.backward()
    assert float(value.grad) == pytest.approx(0.5, rel=1e-12)
    assert float(geometry.grad) == pytest.approx(0.7e-4, rel=1e-12)


def start(count: int = 7, frames: int = 3) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    random = torch.Generator().manual_seed(1)
    places = torch.rand(count, 3, generator=random)
    return start_appearance(places, frames, 5, 16, 0), places


def test_the_network_is_that_of_its_layers() -> None:
    """The oracle joins all inputs of a Gaussian, in float64; tolerance 1e-5."""
    tensors, _ = start()
    exact = {name: value.double() for name, value in tensors.items()}
    colors = torch.rand(7, 3, generator=torch.Generator().manual_seed(2))
    frame = tensors["frame"][[2, 0]] * 50.0
    look = appear(tensors, colors, frame, 0.5)
    for row in range(2):
        known = torch.cat((colors.double(), exact["gaussian"]), dim=-1)
        hidden = torch.cat((known, frame[row].double().expand(7, -1)), dim=-1)
        for layer in ("1", "2"):
            hidden = torch.relu(
                hidden @ exact[f"network.layer_{layer}"].T + exact[f"network.bias_{layer}"]
            )
        out = hidden @ exact["network.layer_3"].T + exact["network.bias_3"]
        toned = (colors * (1.0 + 0.5 * out[:, :3]) + 0.5 * out[:, 3:6]).clamp(0.0, 1.0)
        expected = (
            toned,
            torch.log1p((math.e - 1.0) * out[:, 6:7].exp()),
            out[:, 7:10].sigmoid(),
            (out[:, 10:] - 3.0).sigmoid(),
        )
        found = (look.colors, look.uncertainty, look.transient, look.share)
        for ours, theirs in zip(found, expected, strict=True):
            torch.testing.assert_close(ours[row].double(), theirs.double(), atol=1e-5, rtol=1e-5)


def test_without_a_tone_the_colours_stay() -> None:
    tensors, _ = start()
    colors = torch.rand(7, 3)
    assert torch.equal(appear(tensors, colors, tensors["frame"], 0.0).colors[1], colors)


def test_gaussians_start_as_octaves_of_their_places() -> None:
    tensors, places = start()
    features = tensors["gaussian"]
    assert features.shape == (7, 6 * OCTAVES)
    half = 3 * OCTAVES
    torch.testing.assert_close(features[:, 0], torch.sin(2.0 * math.pi * places[:, 0]))
    torch.testing.assert_close(features[:, half + 1], torch.cos(4.0 * math.pi * places[:, 0]))


def test_places_are_in_the_hand_s_own_size() -> None:
    corners = torch.randn(500, 3, 3, generator=torch.Generator().manual_seed(0)) * 0.05
    places = places_at_rest(corners, torch.full((500, 3), 1.0 / 3.0))
    torch.testing.assert_close(places.mean(dim=0), torch.full((3,), 0.5), atol=1e-5, rtol=0.0)
    inside = ((places >= 0.0) & (places <= 1.0)).float().mean(dim=0)
    assert (inside > 0.95).all()


def test_gaussians_without_extent_lie_in_the_middle() -> None:
    corners = torch.rand(4, 3, 3, generator=torch.Generator().manual_seed(0))
    mix = torch.full((4, 3), 1.0 / 3.0)
    assert places_at_rest(corners[:1], mix[:1]).tolist() == [[0.5, 0.5, 0.5]]
    corners[..., 1] = 0.0
    flat = places_at_rest(corners, mix)
    assert flat[:, 1].tolist() == [0.5] * 4
    assert (flat[:, 0] != 0.5).all()


def wild_recipe(make_training: TrainingMaker, **settings: object) -> WildRecipe:
    return WildRecipe(material_of(make_training()), WildMethod({**QUICK, **settings}).settings)


def test_test_frames_look_like_the_least_uncertain(make_training: TrainingMaker) -> None:
    recipe = wild_recipe(make_training, test_share=0.1)
    recipe.frame_uncertainty = torch.arange(len(recipe.frame_uncertainty), 0.0, -1.0)
    expected = recipe.tensors["frame"][-3:].mean(dim=0, keepdim=True)
    torch.testing.assert_close(recipe.test_frame(), expected)


def test_the_uncertainty_is_drawn_as_one_more_channel(make_training: TrainingMaker) -> None:
    """An opaque hand whose Gaussians all have the same uncertainty has it at every pixel."""
    recipe = wild_recipe(make_training)
    recipe.model.gaussians.logit_opacities.fill_(8.0)
    recipe.tensors["network.layer_3"].zero_()
    recipe.tensors["network.bias_3"][6] = 2.0
    batch = batch_of(recipe.material, 0, 1, fraction=0.5)
    with torch.no_grad():
        drawing = recipe.draw(batch)
        weights = recipe.weights(batch, drawing)
    expected = math.log1p((math.e - 1.0) * math.exp(2.0))
    solid = drawing.coverage[..., 0] > 0.999
    assert solid.any()
    torch.testing.assert_close(
        drawing.uncertainty[solid],
        torch.full_like(drawing.uncertainty[solid], expected),
        atol=1e-2,
        rtol=0.0,
    )
    assert (drawing.uncertainty[drawing.coverage[..., 0] == 0.0] == 1.0).all()
    # 2.6 is uncertain: no pixel of the hand counts, and those around it do.
    assert (weights[solid & (batch.masks > 0.5)] == 0.0).all()
    assert (weights[batch.masks == 0.0] > 0.0).all()


def test_before_its_share_of_the_fit_nothing_is_left_out(make_training: TrainingMaker) -> None:
    recipe = wild_recipe(make_training, mask_from=0.3)
    recipe.tensors["network.bias_3"][6] = 2.0
    with torch.no_grad():
        for fraction, kept in ((0.2, True), (0.4, False)):
            batch = batch_of(recipe.material, 0, 1, fraction=fraction)
            hand = batch.masks > 0.5
            weights = recipe.weights(batch, recipe.draw(batch))
            assert bool((weights[hand] > 0.0).all()) is kept


def test_nerf_w_draws_what_its_loss_compares(make_training: TrainingMaker) -> None:
    """Oracle: the paper's loss, with the likelihood that is tested above."""
    recipe = wild_recipe(make_training, uncertainty="nerf-w", error_unit=0.3)
    batch = batch_of(recipe.material, 0)
    drawing = recipe.draw(batch)
    assert drawing.shared.shape[-1] == 0
    weights = recipe.weights(batch, drawing)
    square = ((drawing.image - batch.images) / 0.3).square().mean(dim=-1)
    expected = (gauss_loss(square, drawing.uncertainty, LEAST) * weights).mean()
    expected = expected + 0.01 * drawing.transient
    torch.testing.assert_close(recipe.loss(batch, drawing, weights), expected)


SETTINGS = {**QUICK, "steps": 150}


def under_another_light(training: TrainingCapture) -> TrainingCapture:
    """Two of five training frames are darker and bluer."""
    read = training.frame

    def frame(index: int) -> np.ndarray:
        image = read(index)
        return (image * (0.5, 0.6, 0.8)).astype(np.uint8) if index % 5 < 2 else image

    training.frame = frame  # type: ignore[method-assign]
    return training


def test_another_light_is_told_from_the_hand(
    make_training: TrainingMaker, make_painted: Callable[[str], Capture]
) -> None:
    """It costs the plain fit some 10 dB; 2.5 dB must come back."""
    training = under_another_light(make_training())
    methods = PlainMethod(SETTINGS, 0), WildMethod(SETTINGS, 0)
    scores = scores_of(training, make_painted("right"), *methods)
    assert scores[1] > scores[0] + 2.5, scores


def test_the_same_seed_gives_the_same_picture(make_training: TrainingMaker) -> None:
    training = make_training()
    frame = int(training.targets[0])
    images = []
    for seed in (3, 3, 4):
        avatar = WildMethod(QUICK, seed).fit(training, Budget(steps=8), SilentReport())
        images.append(avatar.render(training.hand_poses(frame), training.camera(frame)))
    np.testing.assert_array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])


def test_drawing_a_checkpoint_does_not_disturb_the_fit(make_training: TrainingMaker) -> None:
    class Drawing(SilentReport):
        def __call__(self, step, avatar) -> None:  # type: ignore[no-untyped-def]
            super().__call__(step, avatar)
            frame = int(training.validation[0])
            avatar.render(training.hand_poses(frame), training.camera(frame))

    training = make_training()
    fits = [
        WildMethod(QUICK, 0).fit(training, Budget(steps=8), report())
        for report in (Drawing, SilentReport)
    ]
    ours, theirs = (fit.plain.model.parameters() for fit in fits)
    for name, value in ours.items():
        assert torch.equal(value, theirs[name]), name
