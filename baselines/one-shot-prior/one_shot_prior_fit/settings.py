"""Settings of the one-shot prior."""

from __future__ import annotations

from dataclasses import dataclass

from hwp_bench.methods.settings import choice, number
from wildghand.plain.settings import LoopSettings


@dataclass(frozen=True)
class OneShotSettings(LoopSettings):
    """How the frozen prior is bent to a person; weights of terms are the original's."""

    #: Gaussians on each hand.
    gaussians: int = number(12_337, 1, 1_000_000)
    #: Share of D-SSIM in the reconstruction; the rest is L1.
    dssim_weight: float = number(0.0, 0.0, 1.0)
    #: Training frames that are fitted: `clip`, all of them; `one`, see `choose_frame`.
    frames: str = choice("clip", "one")
    #: Rates fall smoothly to `final_rate` (`geometric`), or by half after 2, 5, 10, 20, 35, 50 and
    #: 75 % of the budget (`halving`, the original's).
    decay: str = choice("geometric", "halving")
    #: Adam step of the identity map; the original's is 0.01.
    identity_rate: float = number(0.03)
    #: Adam step of the bias of the texture plane.
    bias_rate: float = number(0.01)
    #: Adam step of gain and offset.
    color_rate: float = number(0.01)
    #: Weight of the reconstruction.
    reconstruction: float = number(10.0)
    #: Weight of a perceptual distance; a bank of filters, because VGG's weights need a file.
    perceptual: float = number(0.1)
    #: Weight of the coverage's distance to the mask.
    mask: float = number(1.0)
    #: Weight of the mean square of the bias.
    bias: float = number(0.01)
