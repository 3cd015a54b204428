"""Triples and 3 x 3 matrices of vectors, as the projection and its gradient use them."""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

from wildghand.splat.kernels.jit import inline
from wildghand.splat.kernels.lanes import select, split_exponent
from wildghand.splat.kernels.rows import fill_exact

_TWO_OVER_LN2 = 2.0 / math.log(2.0)


@inline
def log2(x):
    """Base-2 logarithm in every lane, to 1e-12; x positive."""
    mantissa, exponent = split_exponent(x)
    t = (mantissa - 1.0) / (mantissa + 1.0)
    s = t * t
    series = s * (1.0 / 15.0) + 1.0 / 13.0
    series = s * series + 1.0 / 11.0
    series = s * series + 1.0 / 9.0
    series = s * series + 1.0 / 7.0
    series = s * series + 1.0 / 5.0
    series = s * series + 1.0 / 3.0
    series = s * series + 1.0
    return exponent + t * series * _TWO_OVER_LN2


@inline
def clamp(x, low, high):
    """x brought into [low, high]."""
    x = select(x < low, low, x)
    return select(x > high, high, x)


@inline
def rotation(w, x, y, z):
    """Rotation matrix of a unit quaternion, row by row."""
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz, wx, wy, wz = x * y, x * z, y * z, w * x, w * y, w * z
    one = fill_exact(1.0)
    return (
        (one - (yy + zz) * 2.0, (xy - wz) * 2.0, (xz + wy) * 2.0),
        ((xy + wz) * 2.0, one - (xx + zz) * 2.0, (yz - wx) * 2.0),
        ((xz - wy) * 2.0, (yz + wx) * 2.0, one - (xx + yy) * 2.0),
    )


@inline
def times(row, matrix):
    """Row vector times 3 x 3 matrix."""
    a, b, c = row
    m0, m1, m2 = matrix
    return (
        a * m0[0] + b * m1[0] + c * m2[0],
        a * m0[1] + b * m1[1] + c * m2[1],
        a * m0[2] + b * m1[2] + c * m2[2],
    )


@inline
def dot(a, b):
    """Inner product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline
def cross(a, b):
    """Vector product of two triples."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@inline
def scaled(row, scale):
    """Triple times triple, one by one."""
    return (row[0] * scale[0], row[1] * scale[1], row[2] * scale[2])


@inline
def plus(a, b):
    """Sum of two triples."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@inline
def by(a, number):
    """Triple times one number."""
    return (a[0] * number, a[1] * number, a[2] * number)


@inline
def keep(mask, values):
    """A triple where the mask holds, else zeros, even where it is NaN."""
    zero = fill_exact(0.0)
    return (
        select(mask, values[0], zero),
        select(mask, values[1], zero),
        select(mask, values[2], zero),
    )
