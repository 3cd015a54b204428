"""Heads (i) and (ii) of `compact` on the CPU, compiled: 32 Gaussians at a time, all layers of them.

What lies between the layers never leaves the processor's cache. Widths are padded with zeros to
whole vectors of 16 lanes: a padded channel is 0 before and after its SiLU. Every table is flat,
row after row.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hwp_bench.base.kernels import compiled
from wildghand.network.products import (
    LANES,
    ROWS,
    activate,
    activate_back,
    add,
    add_outer,
    add_products,
    add_rows,
    add_weighted,
    copy,
    load,
    multiply,
    project,
    sigmoid,
)
from wildghand.splat.kernels.jobs import next_job
from wildghand.splat.kernels.lanes import store

#: Gaussians that one thread takes at a time, and those of them that go through all layers together.
PIECE, BLOCK = 512, 32
#: Attributes; the logit of the shadow coefficient is the channel behind them.
CHANNELS = 14

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
#: Numba compiles a function again for each number that it is called with, unless it has a type.
_START, _SINGLE, _CHANNELS, _LANES = (np.int64(number) for number in (0, 1, CHANNELS, LANES))


class Widths(NamedTuple):
    """Channels of each kind, and padded to vectors."""

    places: int  # coordinates of a Gaussian
    harmonics: int  # of its normal
    first: int  # both
    features: int  # harmonics and the second layer
    width: int  # of the two layers of the geometry branch
    point: int  # padded
    head: int  # hidden layer of a head
    half: int  # padded
    heads: int  # both heads
    latent: int  # identity features; 0 without the direct path
    back: int  # heads and, padded, latent
    row: int  # what the layers read of a Gaussian: places, harmonics, second layer
    seen: int  # layers of a Gaussian before their SiLU: point, point, heads


class Layout(NamedTuple):
    """Where each part of the packed weights begins; gradients have the parts up to `light`."""

    first: int  # (first, point)
    second: int  # (width, point)
    heads: int  # (features, heads)
    last: int  # (heads + latent, 16)
    second_bias: int  # (point,)
    heads_bias: int  # (heads,)
    last_bias: int  # (16,)
    light: int  # (features,)
    second_back: int  # (width, point), transposed
    heads_back: int  # (heads, point), transposed, of what is not a harmonic
    last_back: int  # (16, back), transposed
    light_back: int  # (point,) of what is not a harmonic
    size: int


@compiled(nogil=True)
def heads_forward(
    worker, counters, ends, frames, count, places, harmonics, shift, hidden, latent, initial,
    packed, widths, layout, start, seen, raw, shadow, sums,
):  # fmt: skip
    """Raw attributes and shadow coefficients of B frames.

    Args:
        worker, counters, ends: see `wildghand.splat.threads.run`; a job is `PIECE` Gaussians.
        frames, count: B and N.
        places: (N, C); harmonics: (B, N, L); shift: (B, point) of the first layer; hidden:
            (N, head); latent: (N, I); initial: (N, 14), all float32.
        packed, widths, layout: weights, see `Layout`.
        start: logit of the shadow coefficient at the start.
        seen: (B, N rounded up to 8, seen), filled: layers before their SiLU.
        raw: (B, N, 14); shadow: (B, N), filled.
        sums: (pieces, B, room for features) zeros, to which each piece adds its features.
    """
    w = widths
    padded = (count + ROWS - 1) // ROWS * ROWS
    table = np.zeros(BLOCK * w.row + LANES, np.float32)
    one, heads = np.zeros(BLOCK * w.point, np.float32), np.zeros(BLOCK * w.back, np.float32)
    made, logits = np.zeros(BLOCK * LANES, np.float32), np.zeros(BLOCK + LANES, np.float32)
    room = sums.size // (frames * ((count + PIECE - 1) // PIECE))
    job = next_job(worker, counters, ends)
    while job >= 0:
        stop = min(PIECE * (job + 1), count)
        for b in range(frames):
            for n in range(PIECE * job, stop, BLOCK):
                held = min(BLOCK, stop - n)
                rows = (held + ROWS - 1) // ROWS * ROWS
                g = b * count + n
                at = (b * padded + n) * w.seen
                copy(places, n * w.places, w.places, w.places, held, table, _START, w.row)
                copy(harmonics, g * w.harmonics, w.harmonics, w.harmonics, held, table, w.places,
                     w.row)  # fmt: skip
                multiply(table, _START, w.row, w.first, packed, layout.first, w.point, shift,
                         b * w.point, rows, seen, at, w.seen)  # fmt: skip
                activate(seen, at, w.seen, w.point, rows, one, _START, w.point)
                at += w.point
                multiply(one, _START, w.point, w.width, packed, layout.second, w.point, packed,
                         layout.second_bias, rows, seen, at, w.seen)  # fmt: skip
                activate(seen, at, w.seen, w.point, rows, table, w.first, w.row)
                at += w.point
                multiply(table, w.places, w.row, w.features, packed, layout.heads, w.heads, packed,
                         layout.heads_bias, rows, seen, at, w.seen)  # fmt: skip
                activate(seen, at, w.seen, w.heads, rows, heads, _START, w.back)
                add(hidden, n * w.head, w.head, w.head, held, heads, _START, w.back)
                copy(latent, n * w.latent, w.latent, w.latent, held, heads, w.heads, w.back)
                multiply(heads, _START, w.back, w.heads + w.latent, packed, layout.last, _LANES,
                         packed, layout.last_bias, rows, made, _START, _LANES)  # fmt: skip
                project(table, w.places, w.row, w.features, rows, packed, layout.light, logits)
                for r in range(rows):
                    logits[r] += made[r * LANES + CHANNELS] + start
                for r in range(0, rows, LANES):
                    store(logits, r, sigmoid(load(logits, r)))
                copy(logits, _START, _START, held, _SINGLE, shadow, g, _START)
                add(initial, n * CHANNELS, _CHANNELS, _CHANNELS, held, made, _START, _LANES)
                copy(made, _START, _LANES, _CHANNELS, held, raw, g * CHANNELS, _CHANNELS)
                add_rows(table, w.places, w.row, w.features, held, sums, (job * frames + b) * room)
        job = next_job(worker, counters, ends)


@compiled(nogil=True)
def heads_backward(
    worker, counters, ends, frames, count, places, harmonics, hidden, latent, packed, widths,
    layout, seen, shadow, of_raw, of_shadow, of_mean, of_hidden, of_latent, of_shift, of_packed,
):  # fmt: skip
    """Gradients of `heads_forward`.

    Args:
        of_raw: (B, N, 14); of_shadow: (B, N).
        of_mean: (B, point), gradient of each Gaussian's second layer by the mean of all.
        of_hidden: (N, head); of_latent: (N, I), filled.
        of_shift: (pieces, B, point) zeros, to which each piece adds its part.
        of_packed: (pieces, parts of `layout` up to `second_back`) zeros, likewise.
    """
    w, size = widths, layout.second_back
    padded = (count + ROWS - 1) // ROWS * ROWS
    table = np.zeros(BLOCK * w.row + LANES, np.float32)
    one, of_one = np.zeros(BLOCK * w.point, np.float32), np.zeros(BLOCK * w.point, np.float32)
    of_two = np.zeros(BLOCK * w.point, np.float32)
    heads, of_heads = np.zeros(BLOCK * w.back, np.float32), np.zeros(BLOCK * w.back, np.float32)
    top, none = np.zeros(BLOCK * LANES, np.float32), np.zeros(w.back, np.float32)
    job = next_job(worker, counters, ends)
    while job >= 0:
        stop, out = min(PIECE * (job + 1), count), job * size
        for b in range(frames):
            for n in range(PIECE * job, stop, BLOCK):
                held = min(BLOCK, stop - n)
                rows = (held + ROWS - 1) // ROWS * ROWS
                g = b * count + n
                at = (b * padded + n) * w.seen
                # Behind the last Gaussian gradients are zero; the layers hold other Gaussians.
                top[held * LANES :] = _ZERO
                copy(of_raw, g * CHANNELS, _CHANNELS, _CHANNELS, held, top, _START, _LANES)
                for r in range(held):
                    value = shadow[g + r]
                    top[r * LANES + CHANNELS] = of_shadow[g + r] * value * (_ONE - value)
                    top[r * LANES + CHANNELS + 1] = _ZERO
                multiply(top, _START, _LANES, CHANNELS + _SINGLE, packed, layout.last_back, w.back,
                         none, _START, rows, of_heads, _START, w.back)  # fmt: skip
                if b == 0:
                    copy(of_heads, _START, w.back, w.head, held, of_hidden, n * w.head, w.head)
                    copy(of_heads, w.heads, w.back, w.latent, held, of_latent, n * w.latent,
                         w.latent)  # fmt: skip
                else:
                    add(of_heads, _START, w.back, w.head, held, of_hidden, n * w.head, w.head)
                    add(of_heads, w.heads, w.back, w.latent, held, of_latent, n * w.latent,
                        w.latent)  # fmt: skip
                activate_back(seen, at + 2 * w.point, w.seen, w.heads, rows, heads, _START, w.back,
                              of_heads, w.back)  # fmt: skip
                add(hidden, n * w.head, w.head, w.head, held, heads, _START, w.back)
                copy(latent, n * w.latent, w.latent, w.latent, held, heads, w.heads, w.back)
                add_products(heads, _START, w.back, w.heads + w.latent, top, _START, _LANES, _LANES,
                             rows, of_packed, out + layout.last)  # fmt: skip
                add_rows(top, _START, _LANES, _LANES, rows, of_packed, out + layout.last_bias)
                add_rows(
                    of_heads, _START, w.back, w.heads, rows, of_packed, out + layout.heads_bias
                )
                multiply(of_heads, _START, w.back, w.heads, packed, layout.heads_back, w.point,
                         of_mean, b * w.point, rows, of_two, _START, w.point)  # fmt: skip
                of_two[held * w.point :] = _ZERO
                add_outer(top, _CHANNELS, _LANES, rows, packed, layout.light_back, w.point,
                          of_two, _START, w.point)  # fmt: skip
                copy(places, n * w.places, w.places, w.places, held, table, _START, w.row)
                copy(harmonics, g * w.harmonics, w.harmonics, w.harmonics, held, table, w.places,
                     w.row)  # fmt: skip
                activate_back(seen, at + w.point, w.seen, w.point, rows, table, w.first, w.row,
                              of_two, w.point)  # fmt: skip
                add_products(table, w.places, w.row, w.features, of_heads, _START, w.back, w.heads,
                             rows, of_packed, out + layout.heads)  # fmt: skip
                add_weighted(top, _CHANNELS, _LANES, rows, table, w.places, w.row, w.features,
                             of_packed, out + layout.light)  # fmt: skip
                add_rows(
                    of_two, _START, w.point, w.point, rows, of_packed, out + layout.second_bias
                )
                multiply(of_two, _START, w.point, w.width, packed, layout.second_back, w.point,
                         none, _START, rows, of_one, _START, w.point)  # fmt: skip
                activate_back(
                    seen, at, w.seen, w.point, rows, one, _START, w.point, of_one, w.point
                )
                add_products(one, _START, w.point, w.width, of_two, _START, w.point, w.point, rows,
                             of_packed, out + layout.second)  # fmt: skip
                add_products(table, _START, w.row, w.first, of_one, _START, w.point, w.point,
                             rows, of_packed, out + layout.first)  # fmt: skip
                add_rows(
                    of_one, _START, w.point, w.point, rows, of_shift, (job * frames + b) * w.point
                )
        job = next_job(worker, counters, ends)
