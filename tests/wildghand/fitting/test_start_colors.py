"""Where a fit starts from the frames' colours. Oracles: colours by hand, the frames' own pixels."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from odd_fits import part
from painted import TrainingMaker
from tiny_fits import UNJUDGED

from wildghand.fitting.colors import start_from_colors, tint_share
from wildghand.fitting.components import make_fit
from wildghand.fitting.fit import Fit
from wildghand.fitting.light import Lighting, best_of_each_part
from wildghand.gaussians.training import TrainingFrames
from wildghand.light import CastLight, ShadowTable
from wildghand.model.settings import read_settings
from wildghand.visibility.count import read_images, seen_anchors

PLAIN: dict[str, Any] = {**UNJUDGED, "gaussians": 600, "start_colors": False}


@pytest.fixture
def fit(make_training: TrainingMaker) -> Fit:
    return make_fit(make_training(), read_settings(PLAIN), 0, torch.device("cpu"))


@torch.no_grad()
def off_the_frames(fit: Fit, images: torch.Tensor) -> float:
    """Root mean square of the network's colours less those of the pixels where Gaussians are."""
    rows = torch.arange(len(fit.data.frames))
    hands = {"right": fit.clip.hand("right", rows)}
    says = fit.data.visible(rows)
    seen = seen_anchors(hands, fit.clip.viewmats, fit.clip.Ks, says.shape[1:])
    pixels, facing = seen["right"]
    sure = (read_images(says, pixels) > 0.95) & (facing > 0.5)
    made = fit.model.predict("right", hands["right"], fit.clip.parameters["right"][0])
    drawn = made.raw.logit_colors.sigmoid() * made.shadow
    shown = [read_images(images[..., k].contiguous() / 255.0, pixels) for k in range(3)]
    return float((drawn - torch.stack(shown, dim=-1))[sure].square().mean().sqrt())


def start_on(fit: Fit, frames: TrainingFrames) -> None:
    """Start a fit from the colours of other frames."""
    fit.data.frames = frames
    start_from_colors(fit)


def painted_over(fit: Fit, color: np.ndarray) -> torch.Tensor:
    """(R, H, W, 3) uint8 frames in which the lower half of the image has one colour."""
    images = fit.data.frames.images.clone()
    images[:, images.shape[1] // 2 :] = torch.from_numpy(color.astype(np.uint8))
    return images


def test_a_tint_that_is_far_from_the_networks_is_taken_from_the_frames(fit: Fit) -> None:
    images = painted_over(fit, np.array([20, 160, 60]))
    before = off_the_frames(fit, images)
    frames = dataclasses.replace(fit.data.frames, images=images)
    others = {k: v.clone() for k, v in fit.model.network.state_dict().items() if "maps" not in k}
    start_on(fit, frames)
    assert off_the_frames(fit, images) < 0.6 * before
    after = fit.model.network.state_dict()
    assert all(torch.equal(after[name], value) for name, value in others.items())
    # The same once more.
    first = fit.model.network.identity.maps["right"].clone()
    again = make_fit(fit.data.training, fit.settings, 0, torch.device("cpu"))
    start_on(again, frames)
    assert torch.equal(again.model.network.identity.maps["right"], first)


@pytest.mark.parametrize("brightness", [0.6, 1.3])
def test_brightness_is_left_to_the_fit(fit: Fit, brightness: float) -> None:
    """Frames in the colour that the network starts with, all of it darker or brighter."""
    color = 255.0 * fit.data.mean_color.numpy()
    logits = np.log(color / (255.0 - color)) + np.log(brightness)
    images = painted_over(fit, 255.0 / (1.0 + np.exp(-logits)))
    images[:] = images[0, -1, 0]
    before = fit.model.network.identity.maps["right"].clone()
    frames = dataclasses.replace(fit.data.frames, images=images)
    start_on(fit, frames)
    assert torch.equal(fit.model.network.identity.maps["right"], before)


def test_light_and_shadows_are_no_tint(make_training: TrainingMaker) -> None:
    """Frames that the model has drawn in a strong light, in the colours that it starts with."""
    settings = read_settings({**PLAIN, "shadows.enabled": True})
    fit = make_fit(make_training(), settings, 0, torch.device("cpu"))
    strong = np.array([3.0], np.float32)
    fit.model.keep(CastLight(np.array([[0.0, 0.0, -1.0]], np.float32), strong, 0.3))
    size = fit.data.training.width, fit.data.training.height
    assert fit.model.shadows is not None
    part(fit, Lighting)._table = ShadowTable(fit.model.shadows, fit.clip)
    with torch.no_grad():
        drawn = fit.model.draw_frames(fit.clip, torch.arange(len(fit.data.frames)), *size)
    images = (255.0 * drawn.image.clamp(0.0, 1.0)).round().byte()
    frames = dataclasses.replace(fit.data.frames, images=images)
    before = fit.model.network.identity.maps["right"].clone()
    start_on(fit, frames)
    moved = (fit.model.network.identity.maps["right"] - before).abs()
    fit.model.shadows = part(fit, Lighting)._table = None
    start_on(fit, frames)
    misled = (fit.model.network.identity.maps["right"] - before).abs()
    assert float(moved.mean()) < 0.2 * float(misled.mean())


def test_a_fit_starts_so_unless_it_is_switched_off(
    make_training: TrainingMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[bool] = []
    monkeypatch.setattr("wildghand.fitting.colors.start_from_colors", lambda *a: calls.append(True))
    training = make_training()
    for settings in ({**PLAIN, "start_colors": True}, PLAIN, {**PLAIN, "mode": "paper"}):
        make_fit(training, read_settings(settings), 0, torch.device("cpu"))
    assert calls == [True]


def test_a_network_without_a_direct_path_stays_as_it_is(make_training: TrainingMaker) -> None:
    fit = make_fit(
        make_training(), read_settings({**PLAIN, "network.direct": False}), 0, torch.device("cpu")
    )
    before = fit.model.snapshot()
    start_from_colors(fit)
    assert all(torch.equal(value, before[name]) for name, value in fit.model.state_dict().items())


def test_frames_are_spread_and_the_surest_of_their_part() -> None:
    weights = torch.tensor([0.1, 0.9, 0.5, 0.5, 0.2, 0.3])
    assert best_of_each_part(weights, 3).tolist() == [1, 2, 5]
    assert best_of_each_part(weights, 100).tolist() == [0, 1, 2, 3, 4, 5]
    assert best_of_each_part(weights, 1).tolist() == [1]


def test_the_share_is_that_of_the_tint() -> None:
    off = torch.tensor([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0], [0.2, -0.2, 0.0], [0.9, -0.9, 0.0]])
    off = torch.cat((off, torch.tensor([[0.4, 0.0, -0.4]]) / 2**0.5 + 2.0))
    expected = [0.0, 0.0, 0.0, 1.0, 0.5]
    np.testing.assert_allclose(tint_share(off)[:, 0], expected, atol=1e-5)
