"""Lights that are fitted to the colours of places that turn: light = albedo of the place * E(n, v).

E(n, v) = a + sum_k b_k v_k max(0, n . d_k), where v_k in [0, 1] is what is free of the way to
direction d_k. It is linear in a and b, which are nowhere negative: albedo and strengths are solved
by turns.

Before a fit, `find_light` finds what casts shadows (`CastLight`): an ambient light, six walls (half
spaces of the sky around the six axes) and a few lamps. Lamps are found one after the other
(orthogonal matching pursuit, Pati et al. 1993): the next one is the direction which explains most
of what is left, once the albedo has been taken out of both; then all strengths are solved again.
Weights fall with residuals, so that what objects and wrong poses do to single samples counts
little.

After a fit, `fit_light` carries colours on (`KnownLight`). A camera that stands still shows normals
of one half of the sphere; a network's colours of the other half are chance. So a light with
nothing in its way is fitted to the colours that the network gives to normals that frames have
shown; beyond them the network is asked for the nearest known normal, and its colour is multiplied
by the ratio of both irradiances. Residuals count in shares of the albedo alone here: in shares of
what is expected, as above, dark places decide, and novel views lose a decibel.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
import torch
from scipy.optimize import nnls
from scipy.sparse import csr_matrix
from torch import Tensor

from wildghand.gaussians.found import Found, Kept

#: Share of light that is left in the darkest shadow: skin around a place lights it too.
DARKEST = 0.15
#: Linear light to sRGB is about this power.
SRGB = 1.0 / 2.2
# Bounds of what is read: parts of unit vectors, and strengths.
_UNIT, _LARGEST = 1.001, 1e6

# Turns of albedo, strengths and robust weights.
_ROUNDS = 6
#: Irradiance and albedo below these are as dark; in the dark nothing casts a shadow.
NO_LIGHT = 1e-3
# Residuals count a half at this many medians; the misfit counts them from this residual on.
_MEDIANS, _MISFIT = 3.0, 0.25

# Of `find_light`. Directions among which a lamp is sought, as far apart as lamps are told apart.
_CANDIDATES = 162
#: Lamps at most.
LAMPS = 4
# Share of the misfit that a further lamp must take away; less is noise (docs/person.md).
_LEAST_GAIN = 0.006
#: Directions of the sky from which the walls shine; they come after those of the lamps.
SKY = 48
#: Directions of one lamp, its middle first.
CONE = 7
# The six walls.
_WALLS = np.concatenate([np.eye(3), -np.eye(3)])
# Lamps that are nearer than this to each other are one, and how often a direction is refined.
_APART, _REFINED = math.radians(18.0), 3
# Samples that each number of the light needs.
_SAMPLES_EACH = 20

# Of `fit_light`. Directions from which light may come; the ridge on their strengths makes them one
# smooth light.
_DIRECTIONS = 32
# Turns of albedo and light.
_TURNS = 12
# Share of the normals that frames show at the border of what they show, where the network has
# learnt little; it counts as unknown.
_BORDER = 0.25
# Ratios of irradiances beyond these are cut.
_LEAST, _MOST = 0.2, 3.0
# Cosine between normal and viewing direction below which a Gaussian is a part of the rim, which
# the network has learnt as such, and from which it is seen from the front.
_RIM, _FRONT = 0.0, 0.2
# Cosine over which the unknown begins.
_SOFT = 0.1


@dataclass(frozen=True, eq=False)
class CastLight(Found):
    """The light that casts shadows: E(n, v), with a mean of about 1 over the samples."""

    prefix = "shadows_"
    longest: ClassVar = {"K": 4096}
    #: (K, 3) unit vectors towards the light, float32.
    directions: Annotated[np.ndarray, Kept(("K", 3), -_UNIT, _UNIT)]
    #: (K,) not negative, float32.
    strengths: Annotated[np.ndarray, Kept(("K",), 0.0, _LARGEST)]
    #: Light that nothing takes off, not negative.
    ambient: Annotated[float, Kept((), 0.0, _LARGEST)]

    def darkening(self, normals: np.ndarray, free: np.ndarray, darkest: float) -> np.ndarray:
        """Factor on the sRGB colour of skin that it has without anything in the way.

        Args:
            normals: (M, 3) of length 1.
            free: (M, K) in [0, 1], how much of each direction's light arrives.

        Returns:
            (M,) up to 1.
        """
        falling = np.maximum(normals @ self.directions.T, 0.0) * self.strengths
        without = self.ambient + falling.sum(axis=1) + NO_LIGHT
        share = (self.ambient + (falling * free).sum(axis=1) + NO_LIGHT) / without
        return np.clip(share, darkest, 1.0) ** SRGB

    def lit(self) -> CastLight:
        """The same light without the directions that nothing comes from."""
        shining = self.strengths > 0.0
        return CastLight(self.directions[shining], self.strengths[shining], self.ambient)


@dataclass(frozen=True, eq=False)
class KnownLight(Found):
    """A light without shadows, and the cap of normals for which frames have shown it."""

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
        return (self.ambient + facing @ self.strengths).clamp(min=NO_LIGHT)

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
        ratio = (self.irradiance(normals) / self.irradiance(known)) ** SRGB
        return ratio.clamp(_LEAST, _MOST)

    def unknown(self, normals: Tensor, facing: Tensor) -> Tensor:
        """How little is known about a normal, (...) in [0, 1].

        Args:
            normals: (..., 3) of length 1.
            facing: (...) cosine between them and the direction to the camera: the rim of a hand
                is drawn by Gaussians that face away, and frames have shown these.
        """
        beyond = ((self.cosine - normals @ self.axis) / _SOFT).clamp(0.0, 1.0)
        return beyond * ((facing - _RIM) / (_FRONT - _RIM)).clamp(0.0, 1.0)


@dataclass(frozen=True, eq=False)
class LightSamples:
    """M places of the skin in frames of one clip, of both hands together where there are two."""

    #: (M,) number of the place.
    places: np.ndarray
    #: (M, 3) unit normals, world.
    normals: np.ndarray
    #: (M,) linear light, mean over channels, not negative.
    light: np.ndarray
    #: (M,) not negative.
    weights: np.ndarray
    #: From (K, 3) unit vectors towards the light to (M, K), 1 where nothing is in its way, else 0.
    free: Callable[[np.ndarray], np.ndarray | float] = lambda directions: 1.0

    def falling(self, directions: np.ndarray) -> np.ndarray:
        """(M, K) irradiance from directions of strength 1."""
        return np.maximum(self.normals @ directions.T, 0.0) * self.free(directions)

    def suffice(self, count: int) -> bool:
        """Whether that many numbers can be estimated from them."""
        return len(self.places) >= count and bool(self.weights.sum() > 0.0)


def find_light(
    samples: LightSamples, *, lamps: int = LAMPS, softness: float = 12.0
) -> CastLight | None:
    """Find the light that casts shadows; nothing is random. None where samples are too few.

    Args:
        lamps: at most.
        softness: half the angle over which a lamp is spread, degrees: poses are not exact.
    """
    if not samples.suffice(_SAMPLES_EACH * (1 + len(_WALLS) + lamps)):
        return None
    pursuit = _Pursuit(samples)
    sky = spread_directions(SKY)
    # The mean of a half space's cosines, so that a wall of strength 1 gives about 1.
    shares = np.maximum(sky @ _WALLS.T, 0.0) * (4.0 / SKY)
    basis = np.column_stack([np.ones(len(samples.light)), samples.falling(sky) @ shares])
    solved = pursuit.solve(basis)
    candidates = spread_directions(_CANDIDATES)
    falling = samples.falling(candidates)
    found: list[np.ndarray] = []
    while len(found) < lamps:
        lamp, column = pursuit.next_lamp(candidates, falling, found, solved)
        wider = np.column_stack([basis, column])
        trial = pursuit.solve(wider)
        if trial.misfit > solved.misfit * (1.0 - _LEAST_GAIN):
            break
        found.append(lamp)
        basis, solved = wider, trial
    # Each lamp is a cone of seven directions.
    ambient, walls, strengths = np.split(solved.strengths, [1, 1 + len(_WALLS)])
    angle = math.radians(softness)
    cones = [np.concatenate([lamp[None], ring_around(lamp, angle, CONE - 1)]) for lamp in found]
    parts = np.concatenate([np.repeat(strengths / CONE, CONE), shares @ walls])
    return CastLight(
        np.concatenate([*cones, sky]).astype(np.float32),
        parts.astype(np.float32),
        float(np.float32(ambient[0])),
    )


def fit_light(samples: LightSamples, *, ridge: float = 0.03) -> KnownLight | None:
    """Fit a light to the network's colours of places that turn; None if they are too few.

    Args:
        ridge: on the strengths, in the mean size of the normal matrix's diagonal.
    """
    if not samples.suffice(10 * _DIRECTIONS):
        return None
    directions, weights = spread_directions(_DIRECTIONS), samples.weights
    basis = np.column_stack([np.ones(len(weights)), samples.falling(directions)])
    _, places = np.unique(samples.places, return_inverse=True)
    light, scale = np.maximum(samples.light, 0.0), np.sqrt(weights)
    strengths = np.zeros(basis.shape[1])
    strengths[0] = 1.0

    def damped(normal: np.ndarray) -> np.ndarray:
        """All but the ambient light is damped."""
        damping = ridge * np.trace(normal) / len(normal) * (np.arange(len(normal)) > 0)
        return np.asarray(normal + np.diag(damping) + 1e-9 * np.eye(len(normal)))

    for _ in range(_TURNS):
        seen = basis @ strengths
        squares = np.bincount(places, weights * seen**2)
        albedo = np.bincount(places, weights * light * seen) / np.maximum(squares, 1e-9)
        dark = np.maximum(albedo, NO_LIGHT)[places]
        strengths = _solve_strengths(basis * scale[:, None], scale * light / dark, damped)
        strengths = strengths / max(float(np.average(basis @ strengths, weights=weights)), 1e-6)
    axis = weights @ samples.normals
    length = float(np.linalg.norm(axis))
    if length < 1e-6 * weights.sum():  # normals from everywhere: nothing is unknown
        axis, cosine = np.array([0.0, 0.0, 1.0]), -1.0
    else:
        axis = axis / length
        cosine = float(np.quantile(samples.normals @ axis, _BORDER))
    return KnownLight(
        _real(directions), _real(strengths[1:]), _real(strengths[0]), _real(axis), _real(cosine)
    )


@dataclass(frozen=True, eq=False)
class _Solved:
    """Strengths of the columns of a basis, and what they leave."""

    #: (C,) not negative.
    strengths: np.ndarray
    #: (M,) irradiance.
    irradiance: np.ndarray
    #: (M,) light / (albedo * irradiance) - 1.
    residuals: np.ndarray
    #: (M,) weights, robust ones included.
    weights: np.ndarray
    #: Mean of the robust residuals, in [0, 1).
    misfit: float


class _Pursuit:
    """Solves for lights that cast shadows, of given samples, at least one."""

    def __init__(self, samples: LightSamples) -> None:
        self._samples = samples
        _, self._place = np.unique(samples.places, return_inverse=True)
        count = len(self._place)
        ones, rows = np.ones(count), np.arange(count)
        # (P, M): sums over the samples of each place.
        self._sums = csr_matrix((ones, (self._place, rows)))

    def solve(self, basis: np.ndarray) -> _Solved:
        """Solve albedo and strengths by turns; the basis is (M, C) irradiance of each part."""
        samples, light = self._samples, self._samples.light
        strengths = 1.0 / (basis.shape[1] * np.maximum(basis.mean(axis=0), NO_LIGHT))
        robust = np.ones(len(light))
        for _ in range(_ROUNDS):
            irradiance = np.maximum(basis @ strengths, NO_LIGHT)
            ratio = self._ratio(irradiance, samples.weights * robust)
            off = np.abs(ratio - 1.0)
            robust = 1.0 / (1.0 + (off / (_MEDIANS * np.median(off) + 1e-6)) ** 2)
            weights = samples.weights * robust
            # In shares of what is expected, so that dark skin counts as light skin does.
            matrix = basis * (np.sqrt(weights) / irradiance)[:, None]
            strengths = _solve_strengths(
                matrix,
                np.sqrt(weights) * ratio,
                lambda normal: normal + np.diag(1e-4 * np.diag(normal) + 1e-9),
            )
            mean = np.average(basis @ strengths, weights=samples.weights)
            strengths = strengths / max(float(mean), 1e-6)
        irradiance = np.maximum(basis @ strengths, NO_LIGHT)
        off = self._ratio(irradiance, weights) - 1.0
        misfit = np.average(1.0 - 1.0 / (1.0 + (off / _MISFIT) ** 2), weights=samples.weights)
        return _Solved(strengths, irradiance, off, weights, float(misfit))

    def next_lamp(
        self, candidates: np.ndarray, falling: np.ndarray, lamps: list[np.ndarray], left: _Solved
    ) -> tuple[np.ndarray, np.ndarray]:
        """The direction that explains most of what is left, and its (M,) irradiance.

        Args:
            candidates: (K, 3).
            falling: (M, K) their irradiance.
            lamps: those found so far; no other is sought near them.
            left: the light that is not explained yet.
        """
        gains = self._gains(falling, left)
        if lamps:
            near = (candidates @ np.array(lamps).T).max(axis=1) > math.cos(_APART)
            gains = np.where(near, 0.0, gains)
        first = int(np.argmax(gains))
        lamp, column, best = candidates[first], falling[:, first], gains[first]
        angle = 0.5 * math.sqrt(4.0 * math.pi / len(candidates))
        for _ in range(_REFINED):
            around = ring_around(lamp, angle)
            columns = self._samples.falling(around)
            gains = self._gains(columns, left)
            nearest = int(np.argmax(gains))
            if gains[nearest] > best:
                lamp, column, best = around[nearest], columns[:, nearest], gains[nearest]
            else:
                angle *= 0.5
        return lamp, column

    def _gains(self, columns: np.ndarray, left: _Solved) -> np.ndarray:
        """(K,) squared residuals that each of (M, K) columns alone would take away."""
        shares = columns / left.irradiance[:, None]
        # What all samples of a place have in common is its albedo.
        shares = shares - self._means(shares, left.weights)[self._place]
        along = (left.weights * left.residuals) @ shares
        return np.maximum(along, 0.0) ** 2 / (left.weights @ shares**2 + 1e-9)

    def _means(self, values: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """(P, K) weighted means over the samples of each place."""
        total = self._sums @ weights
        return (self._sums @ (values * weights[:, None])) / (total + 1e-9)[:, None]

    def _ratio(self, irradiance: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """(M,) light over albedo times irradiance; the albedo is the mean at each place."""
        albedo = self._means((self._samples.light / irradiance)[:, None], weights)[:, 0]
        return self._samples.light / (np.maximum(albedo, NO_LIGHT)[self._place] * irradiance)


def _solve_strengths(
    matrix: np.ndarray, target: np.ndarray, steady: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Strengths x >= 0, (C,), that bring (M, C) x near the (M,) target; `steady` damps them."""
    normal = matrix.T @ matrix / len(matrix)
    right = matrix.T @ target / len(matrix)
    root = np.linalg.cholesky(steady(normal))
    return np.asarray(nnls(root.T, np.linalg.solve(root, right))[0])


def spread_directions(count: int) -> np.ndarray:
    """(K, 3) unit vectors on a Fibonacci sphere."""
    number = np.arange(count) + 0.5
    z = 1.0 - 2.0 * number / count
    angle, radius = number * math.pi * (3.0 - math.sqrt(5.0)), np.sqrt(1.0 - z * z)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def ring_around(direction: np.ndarray, angle: float, count: int = 6) -> np.ndarray:
    """(count, 3) unit vectors at an angle from a direction of length 1, evenly around it."""
    help_axis = np.eye(3)[int(np.argmin(np.abs(direction)))]
    across = np.cross(direction, help_axis)
    across = across / np.linalg.norm(across)
    turn = np.arange(count) * (2.0 * math.pi / count)
    sides = np.outer(np.cos(turn), across) + np.outer(np.sin(turn), np.cross(direction, across))
    return math.cos(angle) * direction + math.sin(angle) * sides


def _real(values: np.ndarray | float) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float32)
