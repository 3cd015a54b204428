"""The learned identity map, and the attributes that a network starts from."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from wildghand.gaussians.anchored import flat_gaussians
from wildghand.gaussians.attributes import CHANNELS, SIZES, RawAttributes
from wildghand.network.settings import NetworkSettings
from wildghand.network.surface import SurfacePoints

# How far a raw attribute moves with its channel of the identity map. One rate of Adam moves all
# channels alike, so these are the ratios of the rates at which attributes are best fitted.
_GAINS = {
    "offsets": 1.0,
    "log_scales": 0.4,
    "quats": 0.4,
    "logit_opacities": 1.6,
    "logit_colors": 1.0,
}
#: `_GAINS` for each of the 14 channels.
DIRECT_GAINS = tuple(gain for name, gain in _GAINS.items() for _ in range(SIZES[name]))
#: Share of the brightest sRGB that an albedo may start from, so that it can still grow.
BRIGHTEST = 0.95


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


def initial_attributes(
    settings: NetworkSettings, surface: SurfacePoints, log_scale_bias: float
) -> RawAttributes:
    """Flat discs of the hand's mean colour, as seen through the initial shadow coefficient.

    Args:
        settings: opacity and shadow coefficient at the start.
        surface: spacing and colour.
        log_scale_bias: what the activation adds to the log scales.

    Returns:
        (N, k) each, float32.
    """
    spacing = torch.full((len(surface),), float(surface.spacing))
    albedo = (surface.color / settings.initial_shadow).clamp(0.0, BRIGHTEST)
    discs = flat_gaussians(spacing, albedo, opacity=settings.initial_opacity)
    return RawAttributes(
        offsets=discs.offsets,
        log_scales=discs.log_scales - log_scale_bias,
        quats=discs.quats,
        logit_opacities=discs.logit_opacities[:, None],
        logit_colors=discs.logit_colors,
    )
