"""Weighted sums of rows of which index and weight never change, on the CPU."""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np
from torch import Tensor

from hwp_bench.base.compiled import compiled
from wildghand.splat.kernels.jobs import next_job
from wildghand.splat.threads import even_jobs, run, thread_count

#: Rows of the result that one thread takes at a time.
PIECE = 512


def sum_bags(values: Tensor, index: Tensor, weight: Tensor, start: Tensor) -> Tensor:
    """Sum rows: row i of the result sums terms start[i] to start[i + 1], the last one to the end.

    Torch's `embedding_bag` does the same, and takes three times as long where most bags are empty.

    Args:
        values: (inputs, C) float32 on the CPU; no gradient is recorded.
        index: (K,) int64 in [0, inputs), which row each term takes.
        weight: (K,) float32, its factor.
        start: (outputs,) int64, not falling.

    Returns:
        (outputs, C).
    """
    out = values.new_empty(len(start), values.shape[1])
    pieces = -(-len(start) // PIECE)
    run(
        _sum_bags,
        even_jobs(pieces, thread_count(pieces, len(index) + len(start))),
        *(tensor.detach().contiguous().numpy() for tensor in (values, index, weight, start)),
        out.numpy(),
    )
    return out


@compiled(nogil=True)
def _sum_bags(worker, counters, ends, values, index, weight, start, out):
    """See `sum_bags`; a job is `PIECE` rows of `out`, which is filled."""
    rows, channels = out.shape
    job = next_job(worker, counters, ends)
    while job >= 0:
        for row in range(PIECE * job, min(PIECE * (job + 1), rows)):
            last = start[row + 1] if row + 1 < rows else len(index)
            for c in range(channels):
                out[row, c] = np.float32(0.0)
            for term in range(start[row], last):
                source, factor = index[term], weight[term]
                for c in range(channels):
                    out[row, c] += factor * values[source, c]
        job = next_job(worker, counters, ends)
