"""Compiled passes over many tensors: the squares of gradients, and the step of Adam."""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import carray, types

from hwp_bench.base.kernels import compiled
from wildghand.splat.kernels.jit import inline
from wildghand.splat.kernels.jobs import next_job
from wildghand.splat.kernels.lanes import absolute, bits, fma, make_load, square_root, store
from wildghand.splat.kernels.rows import GROUP, fill_exact, load1, total
from wildghand.splat.kernels.simd import Vector, intrinsic

#: Numbers in a piece, a job of one thread.
PIECE = 16_384

_LANES = 16
_ALL = 2**_LANES - 1
_load = make_load(Vector(types.float32, _LANES))
# Rows of a table of addresses: parameters, gradients, first and second moments, counts of steps.
_VALUES, _GRADIENT, _MEAN, _SQUARE, _STEPS = range(5)


class Pieces(NamedTuple):
    """T tensors, cut into P pieces that are worked on one by one."""

    owner: np.ndarray  # (P,) int64, which tensor a piece is of
    first: np.ndarray  # (P,) int64, where in the tensor it begins
    last: np.ndarray  # (P,) int64, and where it ends


@intrinsic
def _floats(typingctx: Any, address: Any) -> Any:
    """A number as the address of float32 values."""
    kind = types.CPointer(types.float32)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], context.get_value_type(kind))

    return kind(address), codegen


@compiled(nogil=True)
def add_squares(worker, counters, ends, addresses, pieces, sums):
    """Sum of the squares of each piece of the gradients.

    Args:
        worker, counters, ends: see `wildghand.splat.kernels.jobs.next_job`; a job is a piece.
        addresses: int64 (5, T), of parameters, gradients, moments and counts.
        pieces: of the tensors.
        sums: float64 (P,), filled.
    """
    while True:
        piece = next_job(worker, counters, ends)
        if piece < 0:
            break
        start, stop = pieces.first[piece], pieces.last[piece]
        values = carray(_floats(addresses[_GRADIENT, pieces.owner[piece]]), (stop,))
        lanes = fill_exact(0.0)
        whole = start + (stop - start) // GROUP * GROUP
        for i in range(start, whole, GROUP):
            (part,) = load1(values, i)
            lanes = lanes + part * part
        found = total(lanes)
        for i in range(whole, stop):
            found += np.float64(values[i]) * np.float64(values[i])
        sums[piece] = found


@compiled()
def advance(addresses, rates, betas, factors):
    """Count a step of every tensor, and find what depends on the count.

    Args:
        addresses: see `add_squares`.
        rates: float64 (T,), learning rates.
        betas: the two decay rates.
        factors: float32 (T, 2), filled: minus the rate over the first bias correction, and the
            root of the second.
    """
    for tensor in range(len(rates)):
        count = carray(_floats(addresses[_STEPS, tensor]), (1,))
        count[0] += np.float32(1.0)
        taken = np.float64(count[0])
        factors[tensor, 0] = -rates[tensor] / (1.0 - betas[0] ** taken)
        factors[tensor, 1] = math.sqrt(1.0 - betas[1] ** taken)


@inline
def _step(arrays, i, scale, rate, root, constants):
    """One step of Adam on 16 numbers, rounded as in torch's kernel."""
    values, gradient, mean, square = arrays
    weight1, beta2, weight2, epsilon = constants
    g, m, s = _load(gradient, i), _load(mean, i), _load(square, i)
    # Where nothing has ever had a gradient nothing can change: most of an identity map is read by
    # no Gaussian. A comparison with NaN is false.
    if bits(absolute(g) + absolute(m) + s <= np.float32(0.0)) == _ALL:
        return
    g = g * scale
    m = fma(g - m, weight1, m)
    s = fma(g * weight2, g, s * beta2)
    store(mean, i, m)
    store(square, i, s)
    store(values, i, _load(values, i) + m * rate / (square_root(s) / root + epsilon))


@compiled(nogil=True)
def update(worker, counters, ends, addresses, pieces, factors, scales, betas, epsilon):
    """One step of Adam on every piece.

    Args:
        worker, counters, ends, addresses, pieces: see `add_squares`.
        factors: see `advance`.
        scales: float32 (T,), what gradients are multiplied with.
        betas: the two decay rates.
        epsilon: added to the root of the second moment.
    """
    constants = (
        np.float32(1.0 - betas[0]),
        np.float32(betas[1]),
        np.float32(1.0 - betas[1]),
        np.float32(epsilon),
    )
    rest = np.zeros((4, _LANES), np.float32)
    while True:
        piece = next_job(worker, counters, ends)
        if piece < 0:
            break
        tensor, start, stop = pieces.owner[piece], pieces.first[piece], pieces.last[piece]
        scale, rate, root = scales[tensor], factors[tensor, 0], factors[tensor, 1]
        values = carray(_floats(addresses[_VALUES, tensor]), (stop,))
        gradient = carray(_floats(addresses[_GRADIENT, tensor]), (stop,))
        mean = carray(_floats(addresses[_MEAN, tensor]), (stop,))
        square = carray(_floats(addresses[_SQUARE, tensor]), (stop,))
        whole = start + (stop - start) // _LANES * _LANES
        for i in range(start, whole, _LANES):
            _step((values, gradient, mean, square), i, scale, rate, root, constants)
        if whole == stop:
            continue
        rest[:] = 0.0
        for i in range(whole, stop):
            k = i - whole
            rest[_VALUES, k], rest[_GRADIENT, k] = values[i], gradient[i]
            rest[_MEAN, k], rest[_SQUARE, k] = mean[i], square[i]
        parts = rest[_VALUES], rest[_GRADIENT], rest[_MEAN], rest[_SQUARE]
        _step(parts, 0, scale, rate, root, constants)
        for i in range(whole, stop):
            k = i - whole
            values[i], mean[i], square[i] = rest[_VALUES, k], rest[_MEAN, k], rest[_SQUARE, k]
