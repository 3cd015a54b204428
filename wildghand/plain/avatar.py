"""The plain avatar: a fitted plain model that is drawn in any pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from hwp_bench.base.errors import UsageError
from hwp_bench.methods.contract import Camera, HandPose
from wildghand.gaussians.anchored import AnchoredGaussians
from wildghand.gaussians.training import join_hands
from wildghand.plain.model import PlainModel
from wildghand.splat.threads import denormals_flushed


class PlainAvatar:
    """A fitted model that can be drawn in any pose; see `hwp_bench.methods.contract.Avatar`.

    Args:
        model: what to draw. While the fit goes on it may be the live one.
        steps: optimizer steps behind it.
    """

    def __init__(self, model: PlainModel, steps: int) -> None:
        self.model = model
        self.steps = steps

    @property
    def device(self) -> str:
        """Where it is drawn."""
        return str(self.model.light.device)

    @denormals_flushed()
    @torch.no_grad()
    def render(self, hands: Mapping[str, HandPose], camera: Camera) -> np.ndarray:
        """Draw the hands that are given.

        Returns:
            (H, W, 4) float32 in [0, 1]: sRGB colour over black (premultiplied) and coverage.

        Raises:
            UsageError: no hand, or one that was not fitted.
        """
        unknown = set(hands) - set(self.model.rigs)
        if unknown or not hands:
            raise UsageError(
                f"asked for {sorted(hands)} of an avatar of {sorted(self.model.rigs)}",
                field="hands",
            )
        model = self.model
        device = model.light.device

        def tensor(array: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(np.asarray(array), dtype=torch.float32, device=device)

        parts = []
        for side, rig in model.rigs.items():
            if side in hands:
                hand = hands[side]
                parts.append(
                    rig.pose(tensor(hand.pose)[None], tensor(hand.betas), tensor(hand.transl)[None])
                )
        poses = join_hands(parts)
        if len(hands) < len(model.rigs):
            sections = list(model.sections(list(hands)))
            chosen = {
                name: torch.cat([value[section] for section in sections])
                for name, value in model.gaussians.parameters().items()
            }
            model = replace(model, gaussians=AnchoredGaussians(**chosen))
        image, coverage = model.render(
            poses,
            tensor(camera.viewmat)[None],
            tensor(camera.K)[None],
            camera.width,
            camera.height,
        )
        rgba = torch.cat((image, coverage), dim=-1)[0]
        return rgba.clamp(0.0, 1.0).nan_to_num(0.0).cpu().numpy()
