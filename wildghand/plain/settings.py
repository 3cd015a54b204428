"""Settings of fits: those of the loop, which every method on it has, and those of the plain fit."""

from __future__ import annotations

from dataclasses import dataclass

from hwp_bench.methods.settings import choice, number
from wildghand.gaussians.shading import MAX_DEGREE


@dataclass(frozen=True)
class LoopSettings:
    """How long is fitted, to how many frames at a time, and what is compared.

    A method with a model of its own extends this class.
    """

    #: Gaussians on each hand.
    gaussians: int = number(12_000, 1, 1_000_000)
    #: Optimizer steps unless the budget says otherwise.
    steps: int = number(2_000, 1, 10_000_000)
    #: Frames in each step.
    batch: int = number(1, 1, 64)
    #: Share of D-SSIM in the loss; the rest is L1.
    dssim_weight: float = number(0.2, 0.0, 1.0)
    #: Weight of a pixel outside the visible-hand mask; 1 inside.
    outside_weight: float = number(0.03, 0.0, 1.0)
    #: The steps' size at the end of the budget, as a share of that at its start; in between it
    #: falls geometrically.
    final_rate: float = number(0.05, 1e-6, 1.0)
    #: `auto` (CUDA where both a GPU and gsplat are there), `cpu` or `cuda`.
    device: str = choice("auto", "cpu", "cuda")


@dataclass(frozen=True)
class FitSettings(LoopSettings):
    """How the plain model is fitted; the defaults are those of the preset `default`.

    A method with more settings extends this class.
    """

    #: Degree of the spherical harmonics of the light, 0 (no shading) to 3.
    shading_degree: int = number(2, 0, MAX_DEGREE)
    #: Opacity of every Gaussian at the start.
    initial_opacity: float = number(0.9, 0.01, 0.99)
    #: Adam step of the offsets, m.
    offset_rate: float = 2e-4
    #: Adam step of the log scales.
    scale_rate: float = 0.01
    #: Adam step of the quaternions.
    quat_rate: float = 0.01
    #: Adam step of the logit opacities.
    opacity_rate: float = 0.05
    #: Adam step of the logit colours.
    color_rate: float = 0.03
    #: Adam step of the light.
    light_rate: float = 0.01
