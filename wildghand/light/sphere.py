"""Directions that are evenly spread over the sphere."""

from __future__ import annotations

import math

import numpy as np


def spread_directions(count: int) -> np.ndarray:
    """(K, 3) unit vectors on a Fibonacci sphere."""
    number = np.arange(count) + 0.5
    z = 1.0 - 2.0 * number / count
    angle, radius = number * math.pi * (3.0 - math.sqrt(5.0)), np.sqrt(1.0 - z * z)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def ring_around(direction: np.ndarray, angle: float, count: int = 6) -> np.ndarray:
    """(count, 3) unit vectors at an angle from a direction, evenly around it.

    Args:
        direction: (3,) of length 1.
        angle: rad.
        count: how many.
    """
    help_axis = np.eye(3)[int(np.argmin(np.abs(direction)))]
    across = np.cross(direction, help_axis)
    across = across / np.linalg.norm(across)
    turn = np.arange(count) * (2.0 * math.pi / count)
    sides = np.outer(np.cos(turn), across) + np.outer(np.sin(turn), np.cross(direction, across))
    return math.cos(angle) * direction + math.sin(angle) * sides
