"""Gaussians that follow a hand's surface, and what every method that fits them shares.

`rig` poses anchors on the hand; `anchored` and `attributes` are the Gaussians on them, before and
after their activation; `training` holds the frames and poses of a capture; `losses`, `perceptual`
and `laplacian` are terms of a loss; `fit_loop` has the parts of a fit's loop.
"""

from wildghand.gaussians.attributes import (
    Activation,
    AnchoredGaussians,
    Attributes,
    PlacedGaussians,
    RawAttributes,
    flat_gaussians,
)
from wildghand.gaussians.fit_loop import Guard, batches, choose_device, spent
from wildghand.gaussians.losses import photometric_loss, ssim_map
from wildghand.gaussians.perceptual import FilterBankLoss, Vgg19
from wildghand.gaussians.regularizers import SurfaceLaplacian, surface_laplacian
from wildghand.gaussians.rig import AnchorPoses, HandRig, make_rig
from wildghand.gaussians.training import TrainingClip, TrainingFrames, load_frames

__all__ = [
    "Activation",
    "AnchorPoses",
    "AnchoredGaussians",
    "Attributes",
    "FilterBankLoss",
    "Guard",
    "HandRig",
    "PlacedGaussians",
    "RawAttributes",
    "SurfaceLaplacian",
    "TrainingClip",
    "TrainingFrames",
    "Vgg19",
    "batches",
    "choose_device",
    "flat_gaussians",
    "load_frames",
    "make_rig",
    "photometric_loss",
    "spent",
    "ssim_map",
    "surface_laplacian",
]
