"""Shared by tests of baselines: the material of a fit, a batch, an object, the score of a fit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from painted import SilentReport, masked_psnr

from hwp_bench.capture import Capture
from hwp_bench.methods.contract import Budget, TrainingCapture
from wildghand.gaussians.training import load_frames
from wildghand.plain.recipe import Batch, FitInputs, PlainRecipe, Recipe, RecipeMethod

#: Colour of the object, 8-bit sRGB.
GREEN = np.array((20, 200, 60), np.uint8)


def material_of(training: TrainingCapture) -> FitInputs:
    """The material of a fit on the CPU, seed 0."""
    return FitInputs(training, load_frames(training), 0, torch.device("cpu"))


def batch_of(material: FitInputs, *rows: int, fraction: float = 0.0) -> Batch:
    """Some rows of the training frames."""
    frames, device, index = material.frames, material.device, torch.tensor(rows)
    images, masks = frames.images_on(device)(index), frames.masks_on(device)(index)
    return Batch(0, fraction, index, images, masks)


def scores_of(training: TrainingCapture, capture: Capture, *methods: RecipeMethod) -> list[float]:
    """PSNR of the hand in test frames, dB, of a fit with each method."""
    fits = (method.fit(training, Budget(), SilentReport()) for method in methods)
    return [masked_psnr(fit, training, capture) for fit in fits]


def object_in(training: TrainingCapture, index: int) -> np.ndarray | None:
    """Where `with_an_object` hides the hand of a frame, (H, W) bool; None where it does not."""
    # Validation frames are clean, as in the data set: they choose the state that is kept.
    if index % 5 >= 2 or index in training.validation:
        return None
    hand = training.mask(index) > 127
    rows, columns = np.nonzero(hand)
    top, middle = int(np.quantile(rows, 0.35)), int(np.quantile(columns, 0.5))
    covered = np.zeros_like(hand)
    covered[top : top + 18, middle - 10 : middle + 10] = True
    return covered


def with_an_object(training: TrainingCapture) -> TrainingCapture:
    """Put a green board before the palm in two of five training frames; the masks keep it."""
    read = training.frame

    def frame(index: int) -> np.ndarray:
        covered, image = object_in(training, index), read(index)
        return image if covered is None else np.where(covered[..., None], GREEN, image)

    training.frame = frame  # type: ignore[method-assign]
    return training


def fit_parts(recipe: Recipe[Any], steps: int) -> None:
    """Take the steps of a fit, whose parts a test then looks at."""
    batches = recipe.batches()
    for step in range(steps):
        recipe.step(next(batches), step / steps)


def share_of_object(
    training: TrainingCapture, recipe: PlainRecipe[Any], judge: Callable[[Batch], torch.Tensor]
) -> tuple[float, float]:
    """Mean of what a method says of pixels of the object, and of the rest of the hand.

    Args:
        judge: gives (1, H, W) of a batch of one frame.
    """
    found: tuple[list[torch.Tensor], list[torch.Tensor]] = ([], [])
    for row, index in enumerate(recipe.material.frames.indices.tolist()):
        covered = object_in(training, index)
        if covered is not None:
            batch = batch_of(recipe.material, row, fraction=0.99)
            hand, values = batch.masks[0] > 0.5, judge(batch)[0]
            board = torch.from_numpy(covered)
            found[0].append(values[hand & board])
            found[1].append(values[hand & ~board])
    first, second = (float(torch.cat(values).float().mean()) for values in found)
    return first, second
