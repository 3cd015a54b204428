"""The visible Gaussians of each image from front to back: a radix sort on float32 depth."""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from wildghand.splat.kernels.jit import kernel
from wildghand.splat.kernels.jobs import next_job

#: Three digits cover the 32 bits of a depth; positive floats sort like their bits.
_BITS = 11
_DIGITS = 1 << _BITS
_MASK = np.uint32(_DIGITS - 1)
_FIRST = np.uint32(_BITS)
_SECOND = np.uint32(2 * _BITS)


@kernel
def sort_by_depth(worker, counters, ends, depths, rows, order, spare, visible, chunk_rows):
    """Sorts every image; equal depths keep the order of their indices.

    Args:
        worker, counters, ends: see `next_job`; a job is an image.
        depths: float32 (I, N); 0 where culled.
        rows: int32 (I, N); tile rows of each Gaussian.
        order: out, int32 (I, N); indices of the visible ones, front to back.
        spare: scratch, int32 (I, N).
        visible: out, int64 (I,); how many there are.
        chunk_rows: out, int64 (I, K + 1); tile rows before each of K equal chunks of the order.
    """
    gaussians = depths.shape[1]
    digits = np.empty((3, _DIGITS), np.int32)
    while True:
        i = next_job(worker, counters, ends)
        if i < 0:
            break
        first, second = order[i], spare[i]
        bits = depths[i].view(np.uint32)
        digits[:] = 0
        m = 0
        for n in range(gaussians):
            value = bits[n]
            if value != 0:
                second[m] = n
                m += 1
                digits[0, value & _MASK] += 1
                digits[1, (value >> _FIRST) & _MASK] += 1
                digits[2, value >> _SECOND] += 1
        for d in range(3):
            before = 0
            for k in range(_DIGITS):
                number = digits[d, k]
                digits[d, k] = before
                before += number
        for k in range(m):
            n = second[k]
            d = bits[n] & _MASK
            first[digits[0, d]] = n
            digits[0, d] += 1
        for k in range(m):
            n = first[k]
            d = (bits[n] >> _FIRST) & _MASK
            second[digits[1, d]] = n
            digits[1, d] += 1
        for k in range(m):
            n = second[k]
            d = bits[n] >> _SECOND
            first[digits[2, d]] = n
            digits[2, d] += 1
        visible[i] = m
        chunks = chunk_rows.shape[1] - 1
        total = 0
        for c in range(chunks):
            chunk_rows[i, c] = total
            for k in range(c * m // chunks, (c + 1) * m // chunks):
                total += rows[i, first[k]]
        chunk_rows[i, chunks] = total
