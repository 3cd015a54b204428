"""Where exported Gaussians lie: their scale, and the axes of other programs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from hwp_bench.base.errors import UsageError
from wildghand.avatar.avatar import PosedGaussians
from wildghand.gaussians.quaternions import quat_multiply

#: SuperSplat's grid has cells of one unit: a hand of 0.2 m is two of them long.
SUPERSPLAT_SCALE = 10.0
# Half a turn about x as a quaternion (w, x, y, z), and what it does to coordinates.
_HALF_TURN, _FLIP = (0.0, 1.0, 0.0, 0.0), np.array([1.0, -1.0, -1.0])


def scaled(splats: PosedGaussians, factor: float) -> PosedGaussians:
    """Make Gaussians larger or smaller about the origin.

    Args:
        splats: the Gaussians, m.
        factor: units of the file in a metre, above 0.

    Raises:
        UsageError: the factor is not a number above 0.
    """
    if not (np.isfinite(factor) and factor > 0.0):
        raise UsageError(f"is {factor}", field="scale", remedy="Use a number above 0.")
    return replace(
        splats,
        means=(splats.means * factor).astype(np.float32),
        scales=(splats.scales * factor).astype(np.float32),
    )


def half_turned(splats: PosedGaussians) -> PosedGaussians:
    """Turn Gaussians by 180 degrees about x: between y up and y down, z back and z front."""
    turn = torch.tensor(_HALF_TURN).expand(len(splats), 4)
    quats = quat_multiply(turn, torch.from_numpy(splats.quats.astype(np.float32)))
    return replace(splats, means=(splats.means * _FLIP).astype(np.float32), quats=quats.numpy())
