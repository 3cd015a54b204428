"""What tests of baselines share: the material of a fit, a batch of it, and the score of a fit."""

from __future__ import annotations

import torch
from painted import SilentReport, masked_psnr

from hwp_bench.capture import Capture
from hwp_bench.methods.contract import Budget, TrainingCapture
from wildghand.gaussians.training import load_frames
from wildghand.plain.recipe import Batch, FitInputs, RecipeMethod


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
