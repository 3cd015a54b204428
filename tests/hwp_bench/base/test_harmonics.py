"""Polynomials on the sphere. Oracle: integrals over points that lie evenly on it."""

from __future__ import annotations

import numpy as np
import pytest

from hwp_bench.base.colors import COUNT, harmonics


def test_pixels_without_a_normal_get_the_constant_alone() -> None:
    flat = harmonics(np.zeros((2, 3)))
    assert flat[0].tolist() == [1.0, *[0.0] * 8]
    unit = np.array([0.0, 0.0, 1.0])
    assert harmonics(unit)[-1] == pytest.approx(2.0)


def test_they_are_orthogonal_over_the_sphere() -> None:
    # A Fibonacci lattice of 20,000 points integrates polynomials of degree 4 to about 1e-4.
    count = 20_000
    height = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - height**2)
    points = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=-1)
    values = harmonics(points)
    assert values.shape == (count, COUNT)
    products = values.T @ values / count
    np.testing.assert_allclose(products - np.diag(np.diag(products)), 0.0, atol=1e-3)
    assert (np.diag(products) > 0.05).all()
