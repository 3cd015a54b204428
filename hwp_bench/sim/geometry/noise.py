"""Random numbers that depend on their purpose only, and smooth noise made of them."""

from __future__ import annotations

import hashlib

import numpy as np

# Edge of the repeating lattice of random values.
_LATTICE = 32


def generator(seed: int, *purpose: str | int) -> np.random.Generator:
    """Return a generator for one purpose."""
    text = "/".join(str(part) for part in (seed, *purpose))
    words = np.frombuffer(hashlib.sha256(text.encode()).digest(), dtype=np.uint32)
    return np.random.default_rng(words.tolist())


def fractal_noise(
    points: np.ndarray, scale: float, rng: np.random.Generator, octaves: int = 3
) -> np.ndarray:
    """Value noise summed over octaves: (N,) with mean about 0 and standard deviation about 1."""
    from scipy.ndimage import map_coordinates

    lattice = rng.normal(size=(_LATTICE,) * 3)
    total = np.zeros(len(points))
    power = 0.0
    for octave in range(octaves):
        height = 0.5**octave
        where = points / scale * 2.0**octave + 7.3 * octave
        cell = np.floor(where)
        inside = where - cell
        eased = cell + inside * inside * (3.0 - 2.0 * inside)
        total += height * map_coordinates(lattice, eased.T, order=1, mode="grid-wrap")
        power += height * height
    # Trilinear interpolation of white noise leaves about a third of its variance.
    return total / np.sqrt(0.35 * power)
