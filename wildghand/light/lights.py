"""Lights of a clip: their settings, directions, and the one that casts shadows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from wildghand.gaussians.found import Found, Kept

#: Share of the light that is left in the darkest shadow: skin around a place lights it too.
DARKEST = 0.15


def spread_directions(count: int) -> np.ndarray:
    """(K, 3) unit vectors on a Fibonacci sphere."""
    number = np.arange(count) + 0.5
    z = 1.0 - 2.0 * number / count
    angle, radius = number * math.pi * (3.0 - math.sqrt(5.0)), np.sqrt(1.0 - z * z)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def ring_around(direction: np.ndarray, angle: float, count: int = 6) -> np.ndarray:
    """(count, 3) unit vectors at an angle from a direction, evenly around it.

    Args:
        direction: (3,) of length 1.
    """
    help_axis = np.eye(3)[int(np.argmin(np.abs(direction)))]
    across = np.cross(direction, help_axis)
    across = across / np.linalg.norm(across)
    turn = np.arange(count) * (2.0 * math.pi / count)
    sides = np.outer(np.cos(turn), across) + np.outer(np.sin(turn), np.cross(direction, across))
    return math.cos(angle) * direction + math.sin(angle) * sides


# Bounds of what is read: parts of unit vectors, and strengths.
_PART, _MOST_LIGHT = 1.001, 1e6
# Irradiance that is added where two are compared, in that of ordinary skin: in the dark nothing
# casts a shadow.
_DARK = 1e-3
# Linear light to sRGB is about this power.
SRGB = 1.0 / 2.2


@dataclass(frozen=True, eq=False)
class CastLight(Found):
    """E(n, v) = ambient + sum_k strength_k v_k max(0, n . d_k), v_k in [0, 1] what is free."""

    prefix = "shadows_"
    longest: ClassVar = {"K": 4096}
    #: (K, 3) unit vectors towards the light, float32.
    directions: Annotated[np.ndarray, Kept(("K", 3), -_PART, _PART)]
    #: (K,) not negative, float32; the mean irradiance of what was read is about 1.
    strengths: Annotated[np.ndarray, Kept(("K",), 0.0, _MOST_LIGHT)]
    #: Light that nothing takes off, not negative.
    ambient: Annotated[float, Kept((), 0.0, _MOST_LIGHT)]

    def darkening(self, normals: np.ndarray, free: np.ndarray, darkest: float) -> np.ndarray:
        """Factor on the sRGB colour of skin that it has without anything in the way.

        Args:
            normals: (M, 3) of length 1.
            free: (M, K) in [0, 1], how much of each direction's light arrives.

        Returns:
            (M,) up to 1.
        """
        falling = np.maximum(normals @ self.directions.T, 0.0) * self.strengths
        without = self.ambient + falling.sum(axis=1) + _DARK
        share = (self.ambient + (falling * free).sum(axis=1) + _DARK) / without
        return np.clip(share, darkest, 1.0) ** SRGB

    def lit(self) -> CastLight:
        """The same light without the directions that nothing comes from."""
        shining = self.strengths > 0.0
        return CastLight(self.directions[shining], self.strengths[shining], self.ambient)
