"""Settings of the fit with an appearance of each frame."""

from __future__ import annotations

from dataclasses import dataclass

from hwp_bench.methods.settings import choice, number
from wildghand.plain.settings import FitSettings


@dataclass(frozen=True)
class WildSettings(FitSettings):
    """Those of the plain fit, and how appearance and uncertainty are fitted."""

    #: Numbers that stand for a frame.
    frame_features: int = number(32, 1, 1024)
    #: Units in each of the two hidden layers.
    hidden: int = number(128, 1, 4096)
    #: Factor on the network's gains and offsets.
    tone_scale: float = number(1.0, 0.0, 100.0)
    #: Whether D-SSIM compares the colours without the frame's appearance.
    plain_dssim: bool = True
    #: Adam step of the frames' numbers.
    frame_rate: float = 0.01
    #: Adam step of the Gaussians' numbers.
    gaussian_rate: float = 5e-3
    #: Adam step of the network.
    network_rate: float = 2e-3
    #: How the uncertainty acts: `mask` leaves uncertain pixels out; `nerf-w` divides by it, with
    #: a transient colour that is left out of tests; `none` fits the appearance alone.
    uncertainty: str = choice("mask", "nerf-w", "none")
    #: The error that an uncertainty of 1 stands for, sRGB in a frame of mean brightness.
    error_unit: float = number(1.0, 1e-6, 1.0)
    #: Least uncertainty.
    least_uncertainty: float = number(0.1, 1e-6, 1e6)
    #: `mask`: share of the fit before pixels are left out.
    mask_from: float = number(0.3, 0.0, 1.0)
    #: `nerf-w`: weight of the mean share of the transient colour.
    transient_weight: float = number(0.01, 0.0, 1e6)
    #: Share of the frames, the least uncertain ones, whose mean stands for test frames.
    test_share: float = number(0.5, 0.0, 1.0)
