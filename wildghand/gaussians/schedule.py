"""Which frames come when, how far a fit is, and how large its steps are."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from hwp_bench.methods.contract import Budget, Report


def spent(step: int, steps: int, budget: Budget, report: Report) -> float:
    """Share of the budget that is used up: of the steps or of the seconds, whichever is more."""
    if budget.seconds is None:
        return step / steps
    if budget.seconds <= 0.0:
        return 1.0
    return max(step / steps, report.elapsed / budget.seconds)


def batches(count: int, batch: int, seed: int) -> Iterator[torch.Tensor]:
    """Batches of row numbers without end: every row once before any comes again.

    Args:
        count: rows.
        batch: rows in a batch.
        seed: of their order.

    Yields:
        (batch,) int64.
    """
    random = np.random.default_rng(seed)
    queue = np.empty(0, dtype=np.int64)
    while True:
        while len(queue) < batch:
            queue = np.concatenate((queue, random.permutation(count)))
        yield torch.from_numpy(queue[:batch])
        queue = queue[batch:]
