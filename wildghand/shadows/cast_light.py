"""A light whose parts come from directions, so that what stands in the way of each takes it off."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from wildghand.gaussians.found import Found, Kept

# Bounds of what is read: parts of unit vectors, and strengths.
_UNIT, _LARGEST = 1.001, 1e6
# Irradiance that is added where two are compared, in that of ordinary skin: in the dark nothing
# casts a shadow.
_LEAST = 1e-3
# Linear light to sRGB is about this power.
SRGB = 1.0 / 2.2


@dataclass(frozen=True, eq=False)
class CastLight(Found):
    """E(n, v) = ambient + sum_k strength_k v_k max(0, n . d_k), v_k in [0, 1] what is free."""

    prefix = "shadows_"
    longest: ClassVar = {"K": 4096}
    #: (K, 3) unit vectors towards the light, float32.
    directions: Annotated[np.ndarray, Kept(("K", 3), -_UNIT, _UNIT)]
    #: (K,) not negative, float32; the mean irradiance of what was read is about 1.
    strengths: Annotated[np.ndarray, Kept(("K",), 0.0, _LARGEST)]
    #: Light that nothing takes off, not negative.
    ambient: Annotated[float, Kept((), 0.0, _LARGEST)]

    def darkening(self, normals: np.ndarray, free: np.ndarray, darkest: float) -> np.ndarray:
        """Factor on the sRGB colour of skin that it has without anything in the way.

        Args:
            normals: (M, 3) of length 1.
            free: (M, K) in [0, 1], how much of each direction's light arrives.
            darkest: share of the linear light that is left at least.

        Returns:
            (M,) up to 1.
        """
        falling = np.maximum(normals @ self.directions.T, 0.0) * self.strengths
        without = self.ambient + falling.sum(axis=1) + _LEAST
        share = (self.ambient + (falling * free).sum(axis=1) + _LEAST) / without
        return np.clip(share, darkest, 1.0) ** SRGB

    def lit(self) -> CastLight:
        """The same light without the directions that nothing comes from."""
        shining = self.strengths > 0.0
        return CastLight(self.directions[shining], self.strengths[shining], self.ambient)
