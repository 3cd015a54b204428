"""A light that is fitted where a clip shows it, and carried on where it does not.

A camera that stands still shows normals of one half of the sphere. What a network says about the
other half is chance. A matte surface under light that is nowhere negative is simple: irradiance
E(n) = a + sum_k b_k max(0, n . d_k) with a, b_k >= 0. It is fitted to the colours that the network
gives to normals that frames have shown; beyond them the network is asked for the nearest known
normal, and its colour is multiplied by the ratio of both irradiances.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from wildghand.gaussians.found import Found, Kept
from wildghand.light.settings import LightSettings
from wildghand.light.sphere import spread_directions

# Turns of albedo and light.
_TURNS = 12
# Irradiances below this share of the mean are as dark; ratios beyond these are cut.
_DARKEST, _LEAST, _MOST = 1e-3, 0.2, 3.0
# Linear light to sRGB is about this power.
_SRGB = 1.0 / 2.2
# Cosine between normal and viewing direction below which a Gaussian is a part of the rim, which
# the network has learnt as such, and from which it is seen from the front.
_RIM, _FRONT = 0.0, 0.2
# Cosine over which the unknown begins.
_SOFT = 0.1
# Bounds of what is read: parts of unit vectors, and strengths.
_UNIT, _LARGEST = 1.001, 1e6


@dataclass(frozen=True, eq=False)
class LightSamples:
    """M places of the skin in frames."""

    #: (M,) number of the Gaussian.
    places: np.ndarray
    #: (M, 3) unit normals, world.
    normals: np.ndarray
    #: (M,) linear light, mean over channels.
    light: np.ndarray
    #: (M,) not negative.
    weights: np.ndarray


@dataclass(frozen=True, eq=False)
class KnownLight(Found):
    """A light, and the cap of the sphere of normals in which frames have shown it."""

    prefix = "light_"
    longest: ClassVar = {"K": 4096}
    #: (K, 3) unit vectors towards the light.
    directions: Annotated[Tensor, Kept(("K", 3), -_UNIT, _UNIT)]
    #: (K,) strength of the light from each of them; the mean irradiance of the samples is 1.
    strengths: Annotated[Tensor, Kept(("K",), 0.0, _LARGEST)]
    #: () strength of the light from everywhere.
    ambient: Annotated[Tensor, Kept((), 0.0, _LARGEST)]
    #: (3,) middle of the known normals, a unit vector.
    axis: Annotated[Tensor, Kept((3,), -_UNIT, _UNIT)]
    #: () cosine of the cap's angle.
    cosine: Annotated[Tensor, Kept((), -_UNIT, _UNIT)]

    def irradiance(self, normals: Tensor) -> Tensor:
        """E(n) of unit normals (..., 3), positive: (...)."""
        facing = (normals @ self.directions.mT).clamp(min=0.0)
        return (self.ambient + facing @ self.strengths).clamp(min=_DARKEST)

    def nearest_known(self, normals: Tensor) -> Tensor:
        """The nearest normals in the cap: (..., 3); those within it stay."""
        along = normals @ self.axis
        across = normals - along[..., None] * self.axis
        length = across.norm(dim=-1, keepdim=True)
        # Opposite to the axis every direction is as near.
        side = across / length.clamp(min=1e-6)
        border = self.cosine * self.axis + (1.0 - self.cosine**2).clamp(min=0.0).sqrt() * side
        border = border / border.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        return torch.where((along < self.cosine)[..., None], border, normals)

    def ratio(self, normals: Tensor, known: Tensor) -> Tensor:
        """Factor on an sRGB colour at `known` for the same skin at `normals`: (...)."""
        ratio = (self.irradiance(normals) / self.irradiance(known)) ** _SRGB
        return ratio.clamp(_LEAST, _MOST)

    def unknown(self, normals: Tensor, facing: Tensor) -> Tensor:
        """How far a normal is unknown, (...) in [0, 1].

        Args:
            normals: (..., 3) of length 1.
            facing: (...) cosine between them and the direction to the camera: the rim of a hand
                is drawn by Gaussians that face away, and frames have shown these.
        """
        beyond = ((self.cosine - normals @ self.axis) / _SOFT).clamp(0.0, 1.0)
        return beyond * ((facing - _RIM) / (_FRONT - _RIM)).clamp(0.0, 1.0)


def fit_light(samples: LightSamples, settings: LightSettings) -> KnownLight | None:
    """Fit a light to the colours of places that turn: light = albedo of the place * E(n).

    Albedo and light are solved by turns; both are ratios, so that dark skin counts as light skin.

    Args:
        samples: of one clip, of both hands together where there are two.
        settings: how.

    Returns:
        The light; None where there are too few samples.
    """
    if len(samples.places) < 10 * settings.directions or not samples.weights.sum() > 0.0:
        return None
    directions = spread_directions(settings.directions)
    facing = np.maximum(samples.normals @ directions.T, 0.0)
    basis = np.column_stack([np.ones(len(facing)), facing])
    _, places = np.unique(samples.places, return_inverse=True)
    light, weights = np.maximum(samples.light, 0.0), samples.weights
    strengths = np.zeros(basis.shape[1])
    strengths[0] = 1.0
    for _ in range(_TURNS):
        seen = basis @ strengths
        squares = np.bincount(places, weights * seen**2)
        albedo = np.bincount(places, weights * light * seen) / np.maximum(squares, 1e-9)
        dark = np.maximum(albedo, 1e-3)[places]
        scale = np.sqrt(weights)
        matrix = basis * scale[:, None]
        normal = matrix.T @ matrix / len(matrix)
        right = matrix.T @ (scale * light / dark) / len(matrix)
        ridge = settings.ridge * np.trace(normal) / len(normal) * np.eye(len(normal))
        ridge[0, 0] = 0.0
        root = np.linalg.cholesky(normal + ridge + 1e-9 * np.eye(len(normal)))
        strengths = nnls(root.T, np.linalg.solve(root, right))[0]
        strengths = strengths / max(float(np.average(basis @ strengths, weights=weights)), 1e-6)
    axis = weights @ samples.normals
    length = float(np.linalg.norm(axis))
    if length < 1e-6 * weights.sum():  # normals from everywhere: nothing is unknown
        axis, cosine = np.array([0.0, 0.0, 1.0]), -1.0
    else:
        axis = axis / length
        cosine = float(np.quantile(samples.normals @ axis, settings.border))
    return KnownLight(
        directions=_real(directions),
        strengths=_real(strengths[1:]),
        ambient=_real(strengths[0]),
        axis=_real(axis),
        cosine=_real(cosine),
    )


def _real(values: np.ndarray | float) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float32)
