"""The one-shot prior. Oracles: formulas by hand, and a stranger's hand whose back it never saw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from fitted_parts import material_of
from painted import SilentReport, TrainingMaker, masked_psnr

from hwp_bench.capture import Capture
from hwp_bench.methods.contract import Avatar, Budget, TrainingCapture
from one_shot_prior_fit.method import (
    HALVED_AFTER,
    OneShotModel,
    OneShotRecipe,
    OneShotSettings,
    choose_frame,
    only,
)
from wildghand.gaussians.training import TrainingFrames
from wildghand.plain.loop import run_fit
from wildghand.plain.recipe import FitSettings, PlainRecipe

CPU = torch.device("cpu")
SMALL = OneShotSettings(gaussians=500, steps=3, device="cpu")


def test_one_palm_tells_the_prior_what_the_back_is_like(
    turned: Capture, turned_hand: TrainingCapture
) -> None:
    """A single frame of a dark person's pale palm; the test frames show the back of the hand.

    The plain fit paints it in the palm's colour. The frozen prior knows other people's hands and
    must be 2 dB better.
    """
    training, material = turned_hand, material_of(turned_hand)
    settings = OneShotSettings(gaussians=1000, steps=60, device="cpu", frames="one")
    ours = run_fit(OneShotRecipe(material, settings), Budget(), SilentReport())
    frame = only(material.frames, choose_frame(material.frames))
    plain = PlainRecipe(
        replace(material, frames=frame),
        FitSettings(gaussians=1000, steps=60, device="cpu", shading_degree=0),
    )
    other = run_fit(plain, Budget(), SilentReport())
    assert score(ours, training, turned) > score(other, training, turned) + 2.0


def score(avatar: Avatar, training: TrainingCapture, capture: Capture) -> float:
    return masked_psnr(avatar, training, capture)  # type: ignore[arg-type]


def test_only_map_bias_gain_and_offset_change(make_training: TrainingMaker) -> None:
    recipe = OneShotRecipe(material_of(make_training()), SMALL)
    network = recipe.fitted.model.network
    fitted = {id(value) for value in recipe.parameters().values()}
    frozen = {
        name: value.clone()
        for name, value in recipe.fitted.model.named_parameters()
        if id(value) not in fitted
    }
    before = recipe.snapshot()
    run_fit(recipe, Budget(), SilentReport())
    assert set(before) == {"identity.right", "bias.right", "color.gain", "color.offset"}
    for name, value in recipe.parameters().items():
        assert not torch.equal(value, before[name]), name
    now = dict(recipe.fitted.model.named_parameters())
    for name, value in frozen.items():
        assert torch.equal(value, now[name]), name
    edge, width = network.settings.plane_resolution, network.settings.plane_width
    assert before["bias.right"].shape == (edge**2, width)


def test_a_bias_is_added_to_every_feature_that_is_read_of_the_plane(
    make_training: TrainingMaker,
) -> None:
    """A plane whose channel k is k everywhere reads as k everywhere, on its own hand only."""
    training = make_training("both")
    model = OneShotModel(training, 200, torch.full((3,), 0.5), 1, 0, CPU)
    network, side = model.model.network, "left"
    width = network.settings.plane_width
    before = {name: network.texture(name).detach() for name in model.plane_bias}
    with torch.no_grad():
        model.plane_bias[side] += torch.arange(width, dtype=torch.float32)
    after = {name: network.texture(name).detach() for name in model.plane_bias}
    assert torch.equal(after["right"], before["right"])
    change = after[side] - before[side]
    assert not change[:, :-width].any()
    expected = torch.arange(width, dtype=torch.float32).expand_as(change[:, -width:])
    torch.testing.assert_close(change[:, -width:], expected, atol=1e-4, rtol=1e-4)


def test_gain_and_offset_act_on_the_colours_under_the_coverage(
    make_training: TrainingMaker,
) -> None:
    """Drawn over black: 0.5 x 0.2 of a half covered pixel, times 2, plus half of 0.1."""
    model = OneShotModel(make_training(), 10, torch.full((3,), 0.5), 1, 0, CPU)
    model.gain.fill_(2.0)
    model.offset.fill_(0.1)
    image = model.colored(torch.full((1, 1, 1, 3), 0.1), torch.full((1, 1, 1, 1), 0.5))
    torch.testing.assert_close(image, torch.full((1, 1, 1, 3), 0.25))


def test_rates_are_halved_after_the_original_s_epochs(make_training: TrainingMaker) -> None:
    recipe = OneShotRecipe(material_of(make_training()), replace(SMALL, decay="halving"))
    assert recipe.rate("color.gain", 0.0) == SMALL.color_rate
    for count, share in enumerate(HALVED_AFTER):
        assert recipe.rate("identity.right", share - 1e-9) == SMALL.identity_rate * 0.5**count
        assert recipe.rate("bias.right", share) == SMALL.bias_rate * 0.5 ** (count + 1)


def test_the_chosen_frame_is_large_and_sharp() -> None:
    """Four frames: small and sharp, large and blurred, large and sharp, and that one again."""
    noise = np.random.default_rng(0).integers(0, 256, (16, 16, 3))
    images = np.stack([noise, np.full((16, 16, 3), 128), noise, noise]).astype(np.uint8)
    masks = np.full((4, 16, 16), 255, dtype=np.uint8)
    masks[0, 6:] = 0
    frames = TrainingFrames(np.arange(10, 14), torch.from_numpy(images), torch.from_numpy(masks))
    assert choose_frame(frames) == 2
    assert only(frames, 2).indices.tolist() == [12]


def test_a_single_frame_is_all_that_the_preset_fits(make_training: TrainingMaker) -> None:
    material = material_of(make_training())
    recipe = OneShotRecipe(material, replace(SMALL, frames="one"))
    assert len(recipe.material.frames) == 1
    assert recipe.clip.viewmats.shape == (1, 4, 4)
    assert len(material.frames) > 1
