"""Putting a model together from its settings."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from hwp_bench.hands import HandTemplate, sample_surface
from wildghand.gaussians.rig import HandRig, rig_of
from wildghand.model.model import WildGHandModel
from wildghand.model.settings import WildGHandSettings
from wildghand.network import PredictionNetwork, mirrored_anchors, surface_points


def make_rigs(
    templates: Mapping[str, HandTemplate], count: int, seed: int, device: torch.device
) -> dict[str, HandRig]:
    """Spread anchors over one hand or two, at the same places of the skin.

    Args:
        templates: by side.
        count: anchors on each hand.
        seed: of their places.
        device: where the tensors live.
    """
    rigs: dict[str, HandRig] = {}
    anchors = None
    for side, template in templates.items():
        # The left template is the right one's mirror image, face by face.
        anchors = (
            sample_surface(template, count, seed) if anchors is None else mirrored_anchors(anchors)
        )
        rigs[side] = rig_of(template, anchors, device)
    return rigs


def assemble(
    templates: Mapping[str, HandTemplate],
    rigs: Mapping[str, HandRig],
    settings: WildGHandSettings,
    mean_color: torch.Tensor,
    frame_count: int,
    seed: int,
) -> WildGHandModel:
    """Make the model that a fit starts from; the same arguments make the same model.

    Args:
        templates: by side.
        rigs: by side, of these templates.
        settings: which parts it has.
        mean_color: (3,) sRGB in [0, 1] of the visible hand.
        frame_count: training frames that are fitted.
        seed: of the initial weights.
    """
    surfaces = {
        side: surface_points(templates[side], rig.anchors, rig.spacing, mean_color)
        for side, rig in rigs.items()
    }
    network = PredictionNetwork(settings.network, surfaces, seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return WildGHandModel(rigs, network, frame_count, dpd=settings.dpd.enabled)
