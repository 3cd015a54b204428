"""The light that casts shadows, from places of the skin that turn and are shaded.

light = albedo(place) * E(n, v), with E of an ambient light, of six walls and of a few lamps, of
which each has its own free share v. The walls are half spaces of the sky around the six axes. Lamps
are found one after the other (orthogonal matching pursuit, Pati et al. 1993): the next one is the
direction which explains most of what is left, once the albedo has been taken out of both; then all
strengths are solved again. Weights fall with residuals, so that what objects and wrong poses do to
single samples counts little.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.sparse import csr_matrix

from wildghand.light.sphere import ring_around, spread_directions
from wildghand.shadows.cast_light import CastLight
from wildghand.shadows.settings import ShadowSettings

#: Directions of the sky from which the walls shine; they come after those of the lamps.
SKY = 48
#: Directions of one lamp, its middle first.
CONE = 7
# The six walls.
_WALLS = np.concatenate([np.eye(3), -np.eye(3)])
# Turns of albedo, strengths and robust weights.
_ROUNDS = 6
# Irradiance and albedo below these are as dark.
_NO_LIGHT = 1e-3
# Residuals count a half at this many medians; the misfit counts them from this residual on.
_MEDIANS, _MISFIT = 3.0, 0.25
# Lamps that are nearer than this to each other are one, and how often a direction is refined.
_APART, _REFINED = math.radians(18.0), 3
# Samples that each number of the light needs.
_SAMPLES_EACH = 20


@dataclass(frozen=True, eq=False)
class ShadowSamples:
    """M places of the skin in frames."""

    #: (M,) number of the place.
    places: np.ndarray
    #: (M, 3) unit normals, world.
    normals: np.ndarray
    #: (M,) linear light, mean over channels, not negative.
    light: np.ndarray
    #: (M,) not negative.
    weights: np.ndarray
    #: From (K, 3) unit vectors towards the light to (M, K), 1 where nothing is in its way, else 0.
    free: Callable[[np.ndarray], np.ndarray]

    def falling(self, directions: np.ndarray) -> np.ndarray:
        """(M, K) irradiance from directions of strength 1, with shadows."""
        return np.maximum(self.normals @ directions.T, 0.0) * self.free(directions)


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


def find_light(samples: ShadowSamples, settings: ShadowSettings) -> CastLight | None:
    """Find a light; nothing is random.

    Args:
        samples: of one clip, of both hands together where there are two.
        settings: how.

    Returns:
        The light; None where there are too few samples.
    """
    most = 1 + len(_WALLS) + settings.lamps
    if len(samples.places) < _SAMPLES_EACH * most or not samples.weights.sum() > 0.0:
        return None
    pursuit = _Pursuit(samples)
    sky = spread_directions(SKY)
    # The mean of a half space's cosines, so that a wall of strength 1 gives about 1.
    shares = np.maximum(sky @ _WALLS.T, 0.0) * (4.0 / SKY)
    basis = np.column_stack([np.ones(len(samples.light)), samples.falling(sky) @ shares])
    solved = pursuit.solve(basis)
    candidates = spread_directions(settings.directions)
    falling = samples.falling(candidates)
    lamps: list[np.ndarray] = []
    while len(lamps) < settings.lamps:
        lamp, column = pursuit.next_lamp(candidates, falling, lamps, solved)
        wider = np.column_stack([basis, column])
        trial = pursuit.solve(wider)
        if trial.misfit > solved.misfit * (1.0 - settings.least_gain):
            break
        lamps.append(lamp)
        basis, solved = wider, trial
    return _light_of(solved.strengths, lamps, sky, shares, settings.softness)


class _Pursuit:
    """Solves for lights of given samples.

    Args:
        samples: at least one.
    """

    def __init__(self, samples: ShadowSamples) -> None:
        self._samples = samples
        _, self._place = np.unique(samples.places, return_inverse=True)
        count = len(self._place)
        ones, rows = np.ones(count), np.arange(count)
        # (P, M): sums over the samples of each place.
        self._sums = csr_matrix((ones, (self._place, rows)))

    def solve(self, basis: np.ndarray) -> _Solved:
        """Solve albedo and strengths by turns.

        Args:
            basis: (M, C) irradiance of each part of the light.
        """
        samples, light = self._samples, self._samples.light
        strengths = 1.0 / (basis.shape[1] * np.maximum(basis.mean(axis=0), _NO_LIGHT))
        robust = np.ones(len(light))
        for _ in range(_ROUNDS):
            irradiance = np.maximum(basis @ strengths, _NO_LIGHT)
            ratio = self._ratio(irradiance, samples.weights * robust)
            off = np.abs(ratio - 1.0)
            robust = 1.0 / (1.0 + (off / (_MEDIANS * np.median(off) + 1e-6)) ** 2)
            weights = samples.weights * robust
            # In shares of what is expected, so that dark skin counts as light skin does.
            matrix = basis * (np.sqrt(weights) / irradiance)[:, None]
            normal = matrix.T @ matrix / len(matrix)
            normal += 1e-4 * np.diag(np.diag(normal)) + 1e-9 * np.eye(len(normal))
            right = matrix.T @ (np.sqrt(weights) * ratio) / len(matrix)
            root = np.linalg.cholesky(normal)
            strengths = nnls(root.T, np.linalg.solve(root, right))[0]
            mean = np.average(basis @ strengths, weights=samples.weights)
            strengths = strengths / max(float(mean), 1e-6)
        irradiance = np.maximum(basis @ strengths, _NO_LIGHT)
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
            lamps: that are there already; near them there is no other.
            left: by what is there already.
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
        return self._samples.light / (np.maximum(albedo, _NO_LIGHT)[self._place] * irradiance)


def _light_of(
    strengths: np.ndarray,
    lamps: list[np.ndarray],
    sky: np.ndarray,
    shares: np.ndarray,
    softness: float,
) -> CastLight:
    """The light of an ambient part, walls and lamps; each lamp is a cone of seven directions."""
    walls = 1 + len(_WALLS)
    directions, parts = [], []
    for lamp, strength in zip(lamps, strengths[walls:], strict=True):
        cone = np.concatenate([lamp[None], ring_around(lamp, math.radians(softness), CONE - 1)])
        directions.append(cone)
        parts.append(np.full(len(cone), strength / len(cone)))
    directions.append(sky)
    parts.append(shares @ strengths[1:walls])
    return CastLight(
        np.concatenate(directions).astype(np.float32),
        np.concatenate(parts).astype(np.float32),
        float(np.float32(strengths[0])),
    )
