"""Polynomials on the sphere, for light that is a function of the normal."""

from __future__ import annotations

import numpy as np

#: Polynomials of degree 0 to 2.
COUNT = 9


def harmonics(normals: np.ndarray) -> np.ndarray:
    """The nine polynomials of degree 0 to 2 that span the spherical harmonics.

    Args:
        normals: (..., 3), unit or zero; at zero only the constant is not 0.

    Returns:
        (..., 9).
    """
    x, y, z = np.moveaxis(normals, -1, 0)
    known = (normals**2).sum(axis=-1) > 0.5
    second = np.where(known, 3.0 * z * z - 1.0, 0.0)
    return np.stack([np.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, second], axis=-1)
