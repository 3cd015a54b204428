"""Occluders before the hand. Oracles: a square in closed form; occluders painted over frames."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from fitted_parts import batch_of, material_of, scores_of
from formed import drawn, formed_capture, over, train_frames, training_of
from painted import (
    QUICK,
    SIZE,
    TrainingMaker,
    hand_parameters,
    painted_avatar,
)

from occluder_splats_fit.method import (
    DISTANCE,
    FrameOccluders,
    OccluderMethod,
    OccluderRecipe,
    make_occluders,
    mask_boxes,
)
from plain_fit.method import PlainMethod

STEPS = 250


def test_one_occluder_is_the_gaussian_of_its_numbers() -> None:
    """Closed form: opacity exp(-d' S^-1 d / 2), with the rasterizer's filter of 0.3 px^2 on S."""
    sigmas, angle, opacity = (6.0, 3.0), 0.5, 0.7
    one = FrameOccluders(
        places=torch.tensor([[[20.3, 30.6]]]),
        log_sigmas=torch.tensor([[sigmas]]).log(),
        angles=torch.tensor([[angle]]),
        logit_opacities=torch.logit(torch.tensor([[opacity]])),
        logit_colors=torch.logit(torch.tensor([[[0.2, 0.5, 0.8]]])),
    )
    K = torch.tensor([[[70.0, 0.0, 25.0], [0.0, 70.0, 30.0], [0.0, 0.0, 1.0]]])
    image, coverage = one.render(torch.tensor([0]), K, 48, 64)
    axes = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    covariance = axes @ np.diag(np.square(sigmas)) @ axes.T + 0.3 * np.eye(2)
    x, y = np.meshgrid(np.arange(48) + 0.5 - 20.3, np.arange(64) + 0.5 - 30.6)
    offset = np.stack([x, y], axis=-1)
    power = np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(covariance), offset)
    expected = opacity * np.exp(-0.5 * power)
    shown = expected > 1.0 / 200.0
    got = coverage[0, ..., 0].numpy()
    # The projection of a disc that is seen from the side differs a little from the disc.
    np.testing.assert_allclose(got[shown], expected[shown], atol=0.02)
    np.testing.assert_allclose(image[0, ..., 2].numpy(), 0.8 * got, atol=1e-5)


def test_boxes_hold_the_mask_and_a_margin() -> None:
    masks = torch.zeros(2, 30, 40, dtype=torch.uint8)
    masks[0, 5:15, 10:30] = 255
    masks[1, 0, 39] = 200
    assert mask_boxes(masks, 0.1).tolist() == [[8, 3, 32, 17], [38, 0, 40, 2]]


def test_occluders_start_in_their_box_in_the_colours_of_the_frame() -> None:
    images = torch.randint(0, 256, (2, 30, 40, 3), dtype=torch.uint8)
    boxes = torch.tensor([[8, 3, 32, 17], [0, 0, 40, 30]])
    made = make_occluders(images, boxes, 50, 0.1, torch.device("cpu"))
    x, y = made.places.unbind(dim=-1)
    for row, (left, top, right, bottom) in enumerate(boxes.tolist()):
        assert left <= x[row].min() <= x[row].max() <= right
        assert top <= y[row].min() <= y[row].max() <= bottom
    colors = images[1, y[1].long(), x[1].long()] / 255.0
    torch.testing.assert_close(made.logit_colors[1].sigmoid(), colors, atol=3e-3, rtol=0.0)
    torch.testing.assert_close(made.logit_opacities.sigmoid(), torch.full((2, 50), 0.1))
    assert DISTANCE > 0.01  # the rasterizer's near plane


@pytest.mark.parametrize("target", ["mask", "box"])
def test_an_image_is_the_occluders_over_the_hand(make_training: TrainingMaker, target: str) -> None:
    """The drawing against both layers drawn apart; only frames of the batch get a gradient."""
    method = OccluderMethod({**QUICK, "target": target, "occluders": 20})
    recipe = OccluderRecipe(material_of(make_training()), method.settings)
    batch = batch_of(recipe.material, 3, 7)
    rows = batch.rows
    for value in recipe.parameters().values():
        value.requires_grad_()
    drawing = recipe.draw(batch)
    front, alpha = recipe.occluders.render(rows, recipe.clip.Ks[rows], SIZE, SIZE)
    hand, cover = recipe.model.render(
        recipe.clip.poses(rows), recipe.clip.viewmats[rows], recipe.clip.Ks[rows], SIZE, SIZE
    )
    torch.testing.assert_close(drawing.image, front + (1.0 - alpha) * hand)
    torch.testing.assert_close(drawing.coverage, cover)
    recipe.loss(batch, drawing, recipe.weights(batch, drawing)).backward()
    touched = recipe.occluders.logit_opacities.grad.abs().sum(dim=1).nonzero()[:, 0]
    assert touched.tolist() == rows.tolist()


@pytest.mark.slow
def test_occluders_are_explained_where_the_plain_fit_takes_them_for_skin(tmp_path: Path) -> None:
    """Blue discs hide three tenths of the hand in each training frame; masks take them for skin.

    The plain fit must miss by 1 dB at least what the fit with occluders reaches.
    """
    hand, avatar, hidden = hand_parameters("right", 0), painted_avatar(("right",)), train_frames()
    random = np.random.default_rng(5)
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5

    def picture(frame: int) -> tuple[np.ndarray, np.ndarray]:
        rgba = drawn(avatar, hand.pose[frame], hand, hand.transl[frame])
        image, mask = over(rgba), rgba[..., 3] > 0.5
        if frame in hidden:
            rows, columns = mask.nonzero()
            for _ in range(2):
                place = random.integers(len(rows))
                near = np.hypot(x - columns[place], y - rows[place]) < random.uniform(6.0, 9.0)
                image[near & mask] = [0.1, 0.2, 0.9]
        return image, mask

    capture = formed_capture(tmp_path / "hidden", hand, picture)
    training = training_of(capture, tmp_path / "request")
    settings = {**QUICK, "steps": STEPS}
    scores = scores_of(training, capture, PlainMethod(settings, 0), OccluderMethod(settings, 0))
    assert scores[1] > scores[0] + 1.0, scores
