"""Settings of the trimmed fit."""

from __future__ import annotations

from dataclasses import dataclass

from hwp_bench.methods.settings import choice, number
from wildghand.plain.settings import FitSettings


@dataclass(frozen=True)
class TrimmedSettings(FitSettings):
    """Those of the plain fit, and how outliers are found."""

    #: Who says which pixels are inliers: `rules` (threshold and neighbourhoods), or `vote` (a
    #: network of the image's features that learns from the rules).
    inliers: str = choice("rules", "vote")
    #: Share of the hand's pixels below the threshold, of all recent errors.
    quantile: float = number(0.7, 0.0, 1.0)
    #: Share of the histogram of errors that stays at each step.
    decay: float = number(0.95, 0.0, 1.0)
    #: Whether a pixel counts whose 3 x 3 neighbours are mostly inliers.
    box: bool = True
    #: Whether the inner 8 x 8 px of a patch of 16 x 16 px count if most of the patch does.
    patch: bool = True
    #: Steps of the published schedule that the whole fit stands for; 0 trims from the start.
    schedule_steps: float = number(3_000.0, 0.0, 1e9)
    #: `vote`: share of errors below which a pixel is surely an inlier.
    sure_inlier: float = number(0.5, 0.0, 1.0)
    #: `vote`: share of errors above which a pixel is surely an outlier.
    sure_outlier: float = number(0.9, 0.0, 1.0)
    #: `vote`: Adam step of the network; it does not fall.
    vote_rate: float = 1e-3
    #: `vote`: weight of max |W1| max |W2|, which keeps the network smooth.
    smoothness: float = number(0.5, 0.0, 1e6)
