"""Oracle: the definition (orthonormal under the mean over the sphere) and scipy's harmonics."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from hwp_bench.base.errors import UsageError
from wildghand.gaussians.shading import sh_basis, sh_count


def sphere(count: int = 20_000) -> np.ndarray:
    """Points spread evenly: the Fibonacci sphere."""
    index = np.arange(count) + 0.5
    z = 1.0 - 2.0 * index / count
    angle = np.pi * (1.0 + math.sqrt(5.0)) * index
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def test_orthonormal_under_the_mean_over_the_sphere() -> None:
    basis = sh_basis(torch.from_numpy(sphere()), 3).numpy()
    np.testing.assert_allclose(basis.T @ basis / len(basis), np.eye(16), atol=1e-3)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_each_degree_spans_what_scipy_spans(degree: int) -> None:
    points = sphere(500)
    polar, azimuth = np.arccos(points[:, 2]), np.arctan2(points[:, 1], points[:, 0])
    complex_basis = np.stack(
        [sph_harm_y(degree, order, polar, azimuth) for order in range(degree + 1)], axis=1
    )
    expected = np.concatenate([complex_basis.real, complex_basis.imag[:, 1:]], axis=1)
    ours = sh_basis(torch.from_numpy(points), degree).numpy()[:, degree**2 :]
    assert ours.shape[1] == 2 * degree + 1
    fitted = ours @ np.linalg.lstsq(ours, expected, rcond=None)[0]
    np.testing.assert_allclose(fitted, expected, atol=1e-12)


@pytest.mark.parametrize("degree", [-1, 4, 1.5])
def test_degrees_that_do_not_exist(degree: int) -> None:
    with pytest.raises(UsageError, match="degree"):
        sh_count(degree)
