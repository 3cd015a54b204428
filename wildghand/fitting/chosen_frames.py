"""Which training frames are read, where a few are enough."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor


def best_of_each_part(weights: Tensor, count: int) -> Tensor:
    """Which frame weighs most in each of some parts of a clip; the first of equal ones.

    Args:
        weights: (R,) of the frames, in their order.
        count: of parts at most, of equal length.

    Returns:
        (count,) int64, ascending, on the CPU; fewer if there are fewer frames.
    """
    given = weights.cpu()
    edges = torch.linspace(0, len(given), min(count, len(given)) + 1).long().tolist()
    parts = itertools.pairwise(edges)
    return torch.tensor([start + int(given[start:end].argmax()) for start, end in parts])
