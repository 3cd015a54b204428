"""Shading of a posed surface by its normals: low-order spherical harmonics of the light."""

from __future__ import annotations

import math

import torch

from hwp_bench.base.errors import UsageError

#: Highest degree of `sh_basis`.
MAX_DEGREE = 3


def sh_count(degree: int) -> int:
    """Number of basis functions up to `degree`, 0 to 3: (degree + 1)^2."""
    if not isinstance(degree, int) or not 0 <= degree <= MAX_DEGREE:
        raise UsageError(f"is {degree!r}", field="degree", remedy=f"Use 0 to {MAX_DEGREE}.")
    return (degree + 1) ** 2


def sh_basis(normals: torch.Tensor, degree: int) -> torch.Tensor:
    """Real spherical harmonics of unit vectors, scaled so that each has mean square 1.

    Args:
        normals: (..., 3) of length 1.
        degree: 0 to 3.

    Returns:
        (..., (degree + 1)^2): 1; then sqrt(3) (x, y, z); then the five of degree 2; then the
        seven of degree 3. Orthonormal under the mean over the sphere.

    Raises:
        UsageError: not a degree in 0..3.

    Source: the polynomial forms of the real spherical harmonics; light of degree 2 is enough
    for a matte surface (Ramamoorthi and Hanrahan, "An efficient representation for irradiance
    environment maps").
    """
    sh_count(degree)
    x, y, z = normals.unbind(-1)
    terms = [torch.ones_like(x)]
    if degree >= 1:
        terms += [math.sqrt(3.0) * axis for axis in (x, y, z)]
    if degree >= 2:
        a = math.sqrt(15.0)
        terms += [a * x * y, a * y * z, a * x * z]
        terms += [0.5 * a * (x * x - y * y), 0.5 * math.sqrt(5.0) * (3.0 * z * z - 1.0)]
    if degree >= 3:
        b, c = math.sqrt(17.5), math.sqrt(10.5)
        d = math.sqrt(105.0)
        fifth = 5.0 * z * z - 1.0
        terms += [
            0.5 * b * y * (3.0 * x * x - y * y),
            d * x * y * z,
            0.5 * c * y * fifth,
            0.5 * math.sqrt(7.0) * z * (5.0 * z * z - 3.0),
            0.5 * c * x * fifth,
            0.5 * d * z * (x * x - y * y),
            0.5 * b * x * (x * x - 3.0 * y * y),
        ]
    return torch.stack(terms, dim=-1)
