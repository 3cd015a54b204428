"""Settings of the fit to exposures."""

from __future__ import annotations

from dataclasses import dataclass

from hwp_bench.methods.settings import number
from wildghand.plain.settings import FitSettings


@dataclass(frozen=True)
class ExposureSettings(FitSettings):
    """The plain fit's settings, and those of the exposures."""

    #: Moments of an exposure at which the hand is drawn.
    moments: int = number(5, 2, 64)
    #: How long the shutter is open at the start, as a share of the time between two frames.
    shutter: float = number(0.25, 0.0, 2.0)
    #: Motion of the hand during the exposure under which a frame is taken for sharp, px.
    least_motion: float = number(1.5, 0.0, 1e6)
    #: Adam step of the two ends' poses, rad.
    pose_rate: float = 1e-4
    #: Adam step of the two ends' places, m.
    transl_rate: float = 1e-5
