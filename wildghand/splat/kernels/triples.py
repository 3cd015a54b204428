"""Triples of numbers, or of vectors of lanes, inside numba."""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

from wildghand.splat.kernels.jit import inline


@inline
def get(array, index):
    """The first three numbers of a row."""
    return (array[index, 0], array[index, 1], array[index, 2])


@inline
def put(array, index, a):
    """Writes a row."""
    array[index, 0], array[index, 1], array[index, 2] = a


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
def minus(a, b):
    """Difference of two triples."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])
