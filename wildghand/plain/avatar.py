"""The plain avatar: a fitted plain model that is drawn in any pose."""

from __future__ import annotations

from dataclasses import replace

import torch

from wildghand.gaussians.attributes import AnchoredGaussians
from wildghand.gaussians.hand_avatar import HandAvatar, PosedHands
from wildghand.gaussians.training import join_hands
from wildghand.plain.model import PlainModel


class PlainAvatar(HandAvatar):
    """A fitted model that can be drawn in any pose; see `hwp_bench.methods.contract.Avatar`.

    Args:
        model: what to draw. While the fit goes on it may be the live one.
        steps: optimizer steps behind it.
    """

    def __init__(self, model: PlainModel, steps: int) -> None:
        super().__init__(model.rigs, model.light.device, steps)
        self.model = model

    def draw(
        self,
        hands: PosedHands,
        viewmats: torch.Tensor,
        Ks: torch.Tensor,
        width: int,
        height: int,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See `HandAvatar.draw`."""
        model = self.model
        poses = join_hands([model.rigs[side].pose(*posed) for side, posed in hands.items()])
        if len(hands) < len(model.rigs):
            sections = list(model.sections(list(hands)))
            chosen = {
                name: torch.cat([value[section] for section in sections])
                for name, value in model.gaussians.parameters().items()
            }
            model = replace(model, gaussians=AnchoredGaussians(**chosen))
        return model.render(poses, viewmats, Ks, width, height)
