"""Pixels behind something. Oracles: drawn squares, the images by hand, gradients of the loss."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from painted import TrainingMaker
from tiny_fits import UNJUDGED

from hwp_bench.methods.contract import TrainingCapture
from wildghand.fitting.components import make_fit
from wildghand.fitting.data import skin_places
from wildghand.fitting.fit import Fit, StepBatch
from wildghand.fitting.judging import MARGIN, HiddenSkin, hidden_skin
from wildghand.fitting.weights import MaskWeights
from wildghand.model.settings import read_settings

CPU = torch.device("cpu")


@pytest.mark.parametrize("size", [60, 240])
def test_only_what_is_well_inside_the_outline_and_left_out_is_hidden(size: int) -> None:
    place = np.zeros((size, size), dtype=np.uint16)
    place[10:50, 10:50] = 7
    mask = np.zeros((size, size), dtype=np.uint8)
    mask[10:50, 30:50] = 255
    margin = max(1, round(MARGIN * size))
    expected = np.zeros((size, size), dtype=bool)
    expected[10 + margin : 50 - margin, 10 + margin : 30] = True
    np.testing.assert_array_equal(hidden_skin([place], mask[None])[0], expected)


def test_without_a_hand_nothing_is_hidden() -> None:
    nothing = np.zeros((8, 8), dtype=np.uint16)
    assert not hidden_skin([nothing], np.zeros((1, 8, 8), np.uint8)).any()


def covered(training: TrainingCapture, **changes: Any) -> tuple[Fit, torch.Tensor]:
    """A fit whose first frame's mask has lost its upper half, and what is hidden in it then."""
    fit = make_fit(training, read_settings({**UNJUDGED, **changes}), 0, CPU)
    masks = fit.data.frames.masks.clone()
    rows = torch.nonzero((masks[0] > 127).any(dim=1))[:, 0]
    masks[0, : int(rows.float().mean())] = 0
    fit.data.frames = dataclasses.replace(fit.data.frames, masks=masks)
    templates = {side: training.template(side) for side in training.sides}
    places = skin_places(training, fit.data.frames, templates)
    for name in ("images", "masks"):  # what was made of the masks before
        vars(fit.data).pop(name, None)
    for kind in (HiddenSkin, MaskWeights):
        found = fit.part(kind)
        if found is not None:
            found.before(fit)
    return fit, torch.from_numpy(hidden_skin(places, masks.numpy()))[0]


@pytest.mark.parametrize("pao", [True, False])
def test_hidden_pixels_are_compared_with_what_is_drawn(
    make_training: TrainingMaker, pao: bool
) -> None:
    fit, hidden = covered(make_training(), **{"pao.enabled": pao})
    assert hidden.sum() > 20
    drawing = fit.draw(StepBatch(torch.tensor([0])))
    target = fit.compare(StepBatch(torch.tensor([0])), drawing)
    assert torch.equal(target.image[0][hidden], drawing.image.detach()[0][hidden])
    masked = (
        fit.data.frames.images[0].float() / 255.0 * (fit.data.frames.masks[0] / 255.0)[..., None]
    )
    torch.testing.assert_close(target.image[0][~hidden], masked[~hidden])


@pytest.mark.parametrize("leave", [True, False])
def test_hidden_pixels_ask_for_nothing_where_they_are_left_out(
    make_training: TrainingMaker, leave: bool
) -> None:
    """The gradient of the image is 0 in them without SSIM, whose windows reach the others."""
    changes = {"terms.leave_hidden": leave, "terms.dssim_weight": 0.0, "pao.enabled": False}
    fit, hidden = covered(make_training(), **changes)
    drawing = fit.draw(StepBatch(torch.tensor([0])))
    drawing.image.retain_grad()
    target = fit.compare(StepBatch(torch.tensor([0])), drawing)
    batch = StepBatch(torch.tensor([0]))
    terms = [term for each in fit.components for term in each.loss(fit, batch, drawing, target)]
    torch.stack(terms).sum().backward()
    asked = drawing.image.grad[0].abs().sum(dim=-1)
    assert asked[~hidden].max() > 0.0
    assert bool((asked[hidden] == 0.0).all()) is leave
