"""Everything that is compiled for a fit of WildGHand, made ready before its clock starts."""

from __future__ import annotations

import functools

import numpy as np
import torch

from hwp_bench.hands.raster import draw_faces, mix_corners
from wildghand.dpd.dpd import DynamicPerturbation, Perturbation
from wildghand.gaussians.attributes import CHANNELS, Activation, RawAttributes
from wildghand.gaussians.fit_loop import ready_device
from wildghand.gaussians.rig import AnchorPoses
from wildghand.model.dress import dress
from wildghand.network import NetworkOutput, Refinement
from wildghand.shadows import Obstacles


def ready_fit(name: str) -> torch.device:
    """Choose the device of a fit, and compile or load for it what the fit needs.

    Args:
        name: `auto`, `cpu` or `cuda`.

    Raises:
        MissingDependency: CUDA was asked for and is not there.
    """
    device = ready_device(name)
    if device.type == "cpu":
        _warm_up()
    return device


@functools.cache
def _warm_up() -> None:
    """Run every kernel of the model, both ways, on one Gaussian."""
    zeros = torch.zeros
    anchors = AnchorPoses(zeros(1, 1, 3), zeros(1, 1, 4))
    with torch.random.fork_rng(devices=[]):
        module = DynamicPerturbation(1, 1)
    prediction = NetworkOutput(
        RawAttributes.split(zeros(1, 1, CHANNELS)),
        zeros(1, 1, 1),
        zeros(1, 3),
        Refinement(zeros(1, 16, 3), zeros(10), zeros(1, 3)),
        zeros(1, 1),
    )
    perturbation = Perturbation(module, module.temporal(torch.tensor([0])))
    gaussians, size = dress(anchors, prediction, Activation(), perturbation, torch.ones(1))
    assert size is not None
    (gaussians.means.sum() + size).backward()
    # Shadows are cast by rays.
    corner = np.eye(3)
    Obstacles([(corner, np.array([[0, 1, 2]]))]).free(corner, corner, corner)
    # The pre-pass draws the hands.
    faces = np.zeros((1, 3), np.int64)
    face, mix = draw_faces(np.zeros((1, 2)), np.zeros(1), faces, (1, 1))
    mix_corners(np.zeros((1, 1)), faces, face.reshape(-1)[:0], mix.reshape(-1, 2)[:0])
