"""Positional encodings: numbers as sines and cosines of rising frequency."""

from __future__ import annotations

import math

import torch
from torch import Tensor

#: Frequencies of a rest position: 3 coordinates x 3 frequencies x 2 = the authors' 18 numbers.
POSITION_FREQUENCIES = 3
#: Length of `encode_positions`.
POSITION_CHANNELS = 3 * 2 * POSITION_FREQUENCIES


def positional_encoding(values: Tensor, frequencies: int) -> Tensor:
    """Sines and cosines of 2^k pi x for k below `frequencies`.

    Args:
        values: (..., D).
        frequencies: at least 1.

    Returns:
        (..., 2 D frequencies): all sines, then all cosines.

    Source: Mildenhall et al., "NeRF", equation 4.
    """
    scales = 2.0 ** torch.arange(frequencies, dtype=values.dtype, device=values.device)
    angles = (math.pi * values[..., None] * scales).flatten(-2)
    return torch.cat((angles.sin(), angles.cos()), dim=-1)


def encode_positions(positions: Tensor) -> Tensor:
    """Encode rest positions; unlike texture coordinates they know no seams.

    Args:
        positions: (N, 3) in [-1, 1].

    Returns:
        (N, 18).
    """
    # Half of the range, so that the lowest frequency tells the two ends of the hand apart.
    return positional_encoding(0.5 * positions, POSITION_FREQUENCIES)


def encode_pose(pose: Tensor, frequencies: int) -> Tensor:
    """Embed a pose; 8 frequencies make the paper's 768 numbers.

    Args:
        pose: (B, 16, 3) axis-angle, rad.
        frequencies: of each of the 48 numbers.

    Returns:
        (B, 96 frequencies).
    """
    # A rotation vector is at most pi long: a quarter turn of the lowest sine is half of that.
    return positional_encoding(pose.flatten(1) / (2.0 * math.pi), frequencies)
