"""Skin at normals that no training frame has shown, in the colours of known ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from wildghand.gaussians.attributes import RawAttributes
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import AnchorPoses
from wildghand.light import KnownLight
from wildghand.network import NetworkOutput


def relit(
    prediction: NetworkOutput,
    light: KnownLight,
    network: Callable[[Tensor], NetworkOutput],
    anchors: AnchorPoses,
    viewmats: Tensor,
) -> NetworkOutput:
    """A prediction with colours at unknown normals carried on from known ones.

    Args:
        prediction: of one hand in B frames.
        light: of the clip.
        network: from (B, N, 3) normals to what the network predicts for them in these frames.
        anchors: of the hand in the frames.
        viewmats: (B, 4, 4) of the cameras. Skin that does not face them stays as it is.
    """
    normals = quat_third_axis(anchors.orientations)
    away = normalize(camera_centres(viewmats)[:, None] - anchors.positions, dim=-1)
    share = light.unknown(normals, (away * normals).sum(dim=-1))
    if not bool((share > 0.0).any()):
        return prediction
    known = light.nearest_known(normals)
    return carried_on(prediction, network(known), light.ratio(normals, known), share)


def camera_centres(viewmats: Tensor) -> Tensor:
    """(B, 3) world places of the cameras of (B, 4, 4) world to camera."""
    return -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]


def carried_on(
    prediction: NetworkOutput, known: NetworkOutput, ratio: Tensor, share: Tensor
) -> NetworkOutput:
    """A prediction whose colours are, by a share, those at known normals under another light.

    Args:
        prediction: in B frames, at the Gaussians' own normals.
        known: at the nearest known normals.
        ratio: (B, N) factor from these to the own ones.
        share: (B, N) in [0, 1].
    """
    mix = share[..., None]
    colors = torch.lerp(
        prediction.raw.logit_colors.expand(*share.shape, 3),
        known.raw.logit_colors.expand(*share.shape, 3),
        mix,
    )
    dark = (prediction.shadow.clamp(min=1e-4), (known.shadow * ratio[..., None]).clamp(min=1e-4))
    shadow = torch.lerp(dark[0].log(), dark[1].log(), mix).exp()
    attributes = {**dict(prediction.raw.items()), "logit_colors": colors}
    return replace(prediction, raw=RawAttributes(**attributes), shadow=shadow)
