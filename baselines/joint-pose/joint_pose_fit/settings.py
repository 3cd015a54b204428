"""Settings of the fit with corrected poses."""

from __future__ import annotations

from dataclasses import dataclass

from hwp_bench.methods.settings import number
from wildghand.plain.settings import FitSettings


@dataclass(frozen=True)
class JointPoseSettings(FitSettings):
    """Those of the plain fit, and how the corrections are fitted."""

    #: Adam step of the corrections of joint angles, rad.
    pose_rate: float = 3e-4
    #: Adam step of the corrections of a hand's place, m.
    transl_rate: float = 3e-4
    #: Weight of the corrections' mean square in the loss, angles in rad and places in dm.
    hold_weight: float = number(0.0, 0.0, 1e6)
