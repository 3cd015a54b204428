"""Samples of the light from a fitted model: colours of Gaussians that turn from frame to frame."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from hwp_bench.base.colors import srgb_to_linear
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.training import TrainingClip
from wildghand.light import LightSamples
from wildghand.model.frames import camera_centres
from wildghand.model.model import WildGHandModel

# Cosine between normal and viewing direction from which a place is seen, and from which its colour
# counts: at a grazing angle pixels are mixed with what is behind.
_SEEN, _COUNTED = 0.02, 0.25
#: Frames that are predicted at a time.
CHUNK = 16


@torch.no_grad()
def light_samples(
    model: WildGHandModel, clip: TrainingClip, frame_weights: Tensor, count: int, seed: int
) -> LightSamples:
    """Read the colours that a model gives to visible places in the training frames.

    Args:
        model: fitted; biases and gains of the frames are left out.
        clip: the hands and cameras of the R frames.
        frame_weights: (R,) how much each frame counts.
        count: samples at most, about.
        seed: of their choice.
    """
    generator = torch.Generator().manual_seed(seed)
    rows = torch.arange(len(frame_weights))
    whole = sum(len(rig) for rig in model.rigs.values()) * len(rows)
    share = min(1.0, 2.0 * count / max(whole, 1))  # about half of the skin faces away
    places, normals, light, weights = [], [], [], []
    first = 0
    for side, rig in model.rigs.items():
        for start in range(0, len(rows), CHUNK):
            part = rows[start : start + CHUNK].to(clip.viewmats.device)
            anchors = clip.hand(side, part)
            prediction = model.predict(side, anchors, clip.parameters[side][0][part])
            turned = quat_third_axis(anchors.orientations)
            away = camera_centres(clip.viewmats[part])[:, None] - anchors.positions
            facing = (normalize(away, dim=-1) * turned).sum(dim=-1).cpu()
            chosen = (facing > _SEEN) & (torch.rand(facing.shape, generator=generator) < share)
            frame, place = chosen.nonzero(as_tuple=True)
            colors = prediction.raw.logit_colors.sigmoid() * prediction.shadow
            colors = colors.expand(*facing.shape, 3).cpu()[frame, place]
            counted = torch.where(facing > _COUNTED, facing, 0.0)[frame, place]
            places.append(place.numpy() + first)
            normals.append(turned.cpu()[frame, place].double().numpy())
            light.append(srgb_to_linear(colors.double().numpy()).mean(axis=1))
            weights.append((counted * frame_weights[start + frame]).double().numpy())
        first += len(rig)
    return LightSamples(
        np.concatenate(places),
        np.concatenate(normals),
        np.concatenate(light),
        np.concatenate(weights),
    )
