"""Making a model from its settings."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from hwp_bench.hands import HandTemplate, sample_surface
from wildghand.gaussians.rig import HandRig, rig_of
from wildghand.model.model import WildGHandModel
from wildghand.model.settings import WildGHandSettings
from wildghand.network import PredictionNetwork, mirrored_anchors, surface_points
from wildghand.subject import SubjectShape


def make_model(
    templates: Mapping[str, HandTemplate],
    settings: WildGHandSettings,
    mean_color: torch.Tensor,
    frame_count: int,
    seed: int,
    device: torch.device,
    subject: SubjectShape | None = None,
) -> WildGHandModel:
    """Make the model that a fit starts from; the same arguments make the same model.

    Args:
        templates: by side.
        settings: which parts it has.
        mean_color: (3,) sRGB in [0, 1] of the visible hand.
        frame_count: training frames that are fitted.
        seed: of the places of the Gaussians, and of the initial weights.
        device: where it lives.
        subject: how the person's hand differs from the templates; None: not at all.
    """
    rigs = make_rigs(templates, settings.gaussians, seed, device, subject)
    surfaces = {
        side: surface_points(templates[side], rig.anchors, rig.spacing, mean_color)
        for side, rig in rigs.items()
    }
    network = PredictionNetwork(settings.network, surfaces, seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        dpd = settings.dpd
        model = WildGHandModel(
            rigs,
            network,
            frame_count,
            dpd=dpd.enabled,
            rank=dpd.rank,
            template=settings.heads.template,
            shadows=settings.shadows,
        )
    if subject is not None:
        model.keep(subject)
    return model.to(device)


def make_rigs(
    templates: Mapping[str, HandTemplate],
    count: int,
    seed: int,
    device: torch.device,
    subject: SubjectShape | None = None,
) -> dict[str, HandRig]:
    """Spread anchors over one hand or two, at the same places of the skin.

    They are spread over the template, whatever the person's hand is: a prior knows these places.

    Args:
        templates: by side.
        count: anchors on each hand.
        seed: of their places.
        device: where the tensors live.
        subject: how the person's hand differs from the templates.
    """
    rigs: dict[str, HandRig] = {}
    anchors = None
    for side, template in templates.items():
        # The left template is the right one's mirror image, face by face.
        anchors = (
            sample_surface(template, count, seed) if anchors is None else mirrored_anchors(anchors)
        )
        bent = template if subject is None else subject.applied(template)
        rigs[side] = rig_of(bent, anchors, device)
    return rigs
