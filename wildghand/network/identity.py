"""The latent identity map: what makes one hand look unlike another, on its UV atlas."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from wildghand.gaussians.attributes import CHANNELS
from wildghand.network.settings import NetworkSettings


class IdentityMap(nn.Module):
    """One square of learnable features for each hand: the two halves of the paper's atlas.

    A capture of one hand has one half only.

    Args:
        settings: resolution, channels and start.
        sides: the hands.
    """

    def __init__(self, settings: NetworkSettings, sides: Iterable[str]) -> None:
        super().__init__()
        self.resolution = settings.identity_resolution
        self.maps = nn.ParameterDict()
        for side in sides:
            values = torch.randn(self.resolution**2, settings.identity_channels).clamp_(-1.0, 1.0)
            values *= settings.identity_spread
            if settings.direct:
                values[:, :CHANNELS] = 0.0
            self.maps[side] = nn.Parameter(values)

    def forward(self, side: str) -> Tensor:
        """Return a hand's half: (resolution^2, channels), row by row from the top."""
        return self.maps[side]
