"""Gauss-Newton steps on a squared error."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

# Steps of Gauss-Newton; all corrections have come to rest by then.
_STEPS = 10
# Times that a step is halved before the search ends.
_HALVINGS = 4
# Weight that draws parameters to no correction, as a share of the mean squared derivative.
_RIDGE = 1e-4


def least_error(
    error: Callable[[np.ndarray], float],
    step: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
) -> np.ndarray:
    """Parameters (K,) of a small error, by steps that are halved until the error falls."""
    best, least = start, error(start)
    for _ in range(_STEPS):
        way = step(best)
        for _ in range(_HALVINGS):
            found = error(best + way)
            if found < least:
                best, least = best + way, found
                break
            way = 0.5 * way
        else:
            break
    return best


def least_squares(derivatives: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """The least squares step: (K,) from derivatives (..., K) and what is missing (...)."""
    flat = derivatives.reshape(-1, derivatives.shape[-1])
    normal = flat.T @ flat
    ridge = _RIDGE * max(float(np.trace(normal)) / len(normal), 1e-12)
    solution: np.ndarray = np.linalg.solve(
        normal + ridge * np.eye(len(normal)), flat.T @ rest.reshape(-1)
    )
    return solution
