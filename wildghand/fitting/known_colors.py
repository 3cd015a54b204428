"""The colours of a hand's Gaussians under the light that a clip shows, by which places compare."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.colors import linear_to_srgb, srgb_to_linear
from wildghand.evidence import ColorChanges
from wildghand.gaussians.training import TrainingClip
from wildghand.light import KnownLight
from wildghand.light.lights import ring_around
from wildghand.model.model import WildGHandModel

# Normals at which colours are read: the axis of the cap that the light knows, and so many around it
# at this share of the cap's angle.
_RING, _INSIDE = 4, 0.6
# sRGB nearer to 0 or 1, and linear light below this, say nothing.
_EDGE, _DARKEST = 0.005, 1e-3


@torch.no_grad()
def known_logits(
    model: WildGHandModel, clip: TrainingClip, side: str, light: KnownLight
) -> np.ndarray:
    """Mean colour of each Gaussian over known normals and poses of the clip.

    Args:
        model: what is read.
        clip: its poses.
        side: which hand.
        light: knows the normals.

    Returns:
        (N, 3) in logits of sRGB.
    """
    poses = clip.parameters[side][0]
    normals = known_normals(light).to(poses)
    rows = torch.linspace(0, len(poses) - 1, len(normals)).long().to(poses.device)
    spread = normals[:, None].expand(-1, len(model.rigs[side]), 3).contiguous()
    made = model.network(side, spread, poses[rows], model.network.features(side))
    colors = (made.raw.logit_colors.sigmoid() * made.shadow).clamp(_EDGE, 1.0 - _EDGE)
    found: np.ndarray = torch.logit(colors).mean(dim=0).double().cpu().numpy()
    return found


def known_normals(light: KnownLight) -> Tensor:
    """(5, 3) normals of the cap that a light knows: its axis, and four around it."""
    axis = light.axis.double().cpu().numpy()
    axis = axis / max(float(np.linalg.norm(axis)), 1e-6)
    angle = _INSIDE * math.acos(max(-1.0, min(1.0, float(light.cosine))))
    return torch.from_numpy(np.concatenate([axis[None], ring_around(axis, angle, _RING)])).float()


def log_linear(logits: np.ndarray) -> np.ndarray:
    """Logarithm of linear light of colours in logits of sRGB."""
    linear = srgb_to_linear(1.0 / (1.0 + np.exp(-logits)))
    return np.log(np.clip(linear, _DARKEST, 1.0))


def changes_to(
    levels: Mapping[str, np.ndarray], logits: Mapping[str, np.ndarray], device: torch.device
) -> ColorChanges:
    """The changes that bring colours to others.

    Args:
        levels: (N, 3) by side, logarithms of linear light, where they are to be.
        logits: (N, 3) by side, of sRGB, where they are.
        device: of the changes.
    """
    changes = {}
    for side, aim in levels.items():
        srgb = linear_to_srgb(np.exp(aim)).clip(_EDGE, 1.0 - _EDGE)
        change = np.log(srgb / (1.0 - srgb)) - logits[side]
        changes[side] = torch.as_tensor(change, dtype=torch.float32, device=device)
    return ColorChanges(changes)
