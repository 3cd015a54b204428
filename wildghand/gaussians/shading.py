"""Shading of a posed surface by its normals: low-order spherical harmonics of the light."""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.errors import UsageError
from hwp_bench.base.kernels import compiled
from wildghand.splat.kernels.jit import next_job
from wildghand.splat.threads import run_pieces

#: Normals that one thread takes at a time.
PIECE = 512

_A, _B, _C, _D = (np.float32(math.sqrt(number)) for number in (15.0, 17.5, 10.5, 105.0))
_THREE, _FIVE, _SEVEN = (np.float32(math.sqrt(number)) for number in (3.0, 5.0, 7.0))
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)


@compiled(nogil=True)
def harmonics_kernel(worker, counters, ends, normals, degree, out, first):
    """See `fill_harmonics`; a job is `PIECE` normals."""
    three, five = np.float32(3.0), np.float32(5.0)
    job = next_job(worker, counters, ends)
    while job >= 0:
        for row in range(PIECE * job, min(PIECE * (job + 1), len(normals))):
            x, y, z = normals[row, 0], normals[row, 1], normals[row, 2]
            o = out[row, first:]
            o[0], o[1], o[2] = _THREE * x, _THREE * y, _THREE * z
            if degree >= 2:
                o[3], o[4], o[5] = _A * x * y, _A * y * z, _A * x * z
                o[6] = _HALF * _A * (x * x - y * y)
                o[7] = _HALF * _FIVE * (three * z * z - _ONE)
            if degree >= 3:
                fifth = five * z * z - _ONE
                o[8] = _HALF * _B * y * (three * x * x - y * y)
                o[9] = _D * x * y * z
                o[10] = _HALF * _C * y * fifth
                o[11] = _HALF * _SEVEN * z * (five * z * z - three)
                o[12] = _HALF * _C * x * fifth
                o[13] = _HALF * _D * z * (x * x - y * y)
                o[14] = _HALF * _B * x * (x * x - three * y * y)
        job = next_job(worker, counters, ends)


def fill_harmonics(normals: Tensor, degree: int, out: Tensor, first: int) -> None:
    """`sh_basis` of (M, 3) normals without the constant, into columns of `out` from `first` on."""
    run_pieces(
        harmonics_kernel,
        len(normals),
        PIECE,
        len(normals),
        normals.detach().contiguous().numpy(),
        degree,
        out.numpy(),
        first,
    )


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
