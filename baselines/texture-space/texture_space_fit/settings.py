"""Settings of the fit in a space of textures."""

from __future__ import annotations

from dataclasses import dataclass

from hwp_bench.methods.settings import number
from wildghand.plain.settings import LoopSettings


@dataclass(frozen=True)
class SpaceSettings(LoopSettings):
    """Those of the loop, and those of texture, light and shape."""

    #: Adam step of the weights of the components, in standard deviations.
    latent_rate: float = 0.03
    #: Adam step of the light's coefficients, as shares of its mean.
    light_rate: float = 0.03
    #: Adam step of the shape parameters.
    betas_rate: float = 3e-3
    #: Weight of the mean square of the components' weights.
    latent_weight: float = number(1e-4, 0.0, 1e4)
    #: Adam step of a logarithm of the albedo that each Gaussian has to itself; 0 for none, as in
    #: Handy.
    residual_rate: float = 0.0
    #: Weight of the mean square of what Gaussians have to themselves.
    residual_weight: float = number(1e-3, 0.0, 1e4)
    #: Weight of the coverage's distance to the mask.
    mask_weight: float = number(0.1, 0.0, 1e4)
