"""A light whose parts come from directions, so that what stands in the way of each takes it off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.errors import BadInput
from wildghand.gaussians.kept_tensors import kept_tensor

# Names under which an avatar keeps a light.
_PREFIX = "shadows_"
# Most directions that are read, and the largest strength.
_MOST_DIRECTIONS, _LARGEST = 4096, 1e6
# Irradiance that is added where two are compared, in that of ordinary skin: in the dark nothing
# casts a shadow.
_LEAST = 1e-3
# Linear light to sRGB is about this power.
SRGB = 1.0 / 2.2


@dataclass(frozen=True, eq=False)
class CastLight:
    """E(n, v) = ambient + sum_k strength_k v_k max(0, n . d_k), v_k in [0, 1] what is free."""

    #: (K, 3) unit vectors towards the light, float32.
    directions: np.ndarray
    #: (K,) not negative, float32; the mean irradiance of what was read is about 1.
    strengths: np.ndarray
    #: Light that nothing takes off, not negative.
    ambient: float

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

    def to_tensors(self) -> dict[str, Tensor]:
        """The fields by the names under which an avatar keeps them."""
        return {
            f"{_PREFIX}directions": torch.from_numpy(self.directions),
            f"{_PREFIX}strengths": torch.from_numpy(self.strengths),
            f"{_PREFIX}ambient": torch.tensor(self.ambient, dtype=torch.float32),
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor], where: str) -> CastLight | None:
        """Read what `to_tensors` made.

        Args:
            tensors: of an avatar.
            where: the file, for messages.

        Returns:
            The light; None where the avatar keeps none.

        Raises:
            BadInput: a part is missing, of another shape, or no light.
        """
        directions = tensors.get(f"{_PREFIX}directions")
        if directions is None:
            return None
        count = len(directions) if directions.ndim == 2 else 0
        shapes = {"directions": (count, 3), "strengths": (count,), "ambient": ()}
        found = {}
        for name, shape in shapes.items():
            field = f"{_PREFIX}{name}"
            if not 0 < count <= _MOST_DIRECTIONS:
                raise BadInput(f"has not the shape {shape}", where=where, field=field)
            bounds = (-1.001, 1.001) if name == "directions" else (0.0, _LARGEST)
            tensor = kept_tensor(tensors, field, shape, bounds, where)
            found[name] = tensor.detach().float().cpu().numpy()
        return cls(found["directions"], found["strengths"], float(found["ambient"]))
