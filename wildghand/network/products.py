"""Products of small matrices over many rows, compiled: what a layer does, and its gradients.

All matrices are parts of flat float32 arrays, row after row. Columns of results come in whole
vectors of 16 lanes and rows in groups of 8, so callers keep room for them.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types

from hwp_bench.base.kernels import compiled, helper
from wildghand.gaussians.attributes import CHANNELS
from wildghand.splat.kernels.jit import inline, next_job
from wildghand.splat.kernels.tiles import exp2
from wildghand.splat.kernels.vectors import (
    Vector,
    fma,
    intrinsic,
    make_fill,
    make_load,
    select,
    splat,
    store,
    store_sums,
)

#: Columns that are worked on together.
LANES = 16
#: Rows that are.
ROWS = 8

FLOATS = Vector(types.float32, LANES)
load = make_load(FLOATS)
fill = make_fill(FLOATS)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_LOG2_E, _LARGEST = np.float32(1.4426950408889634), np.float32(126.0)


@intrinsic
def stay_apart(typingctx: Any) -> Any:
    """Keeps LLVM from copying the function that says this into those that call it.

    A kernel that calls it at eight places would take eight times as long to compile.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        builder.function.attributes.add("noinline")
        return context.get_dummy_value()

    return types.void(), codegen


@intrinsic
def spread(typingctx: Any, array: Any, index: Any) -> Any:
    """One element of an array in every lane: `spread(array, flat_index)`."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return splat(builder, builder.load(builder.gep(data, [args[1]])), LANES)

    return FLOATS(array, types.intp), codegen


@helper
def multiply(
    left,
    left_at,
    left_step,
    inner,
    right,
    right_at,
    columns,
    start,
    start_at,
    rows,
    out,
    out_at,
    out_step,
):
    """out = start + left right, with one row `start` for all."""
    stay_apart()
    for m in range(0, columns, LANES):
        for r in range(0, rows, ROWS):
            c0 = load(start, start_at + m)
            c1, c2, c3, c4, c5, c6, c7 = c0, c0, c0, c0, c0, c0, c0
            a = left_at + r * left_step
            b = right_at + m
            for _ in range(inner):
                row = load(right, b)
                c0 = fma(spread(left, a), row, c0)
                c1 = fma(spread(left, a + left_step), row, c1)
                c2 = fma(spread(left, a + 2 * left_step), row, c2)
                c3 = fma(spread(left, a + 3 * left_step), row, c3)
                c4 = fma(spread(left, a + 4 * left_step), row, c4)
                c5 = fma(spread(left, a + 5 * left_step), row, c5)
                c6 = fma(spread(left, a + 6 * left_step), row, c6)
                c7 = fma(spread(left, a + 7 * left_step), row, c7)
                a += 1
                b += columns
            o = out_at + r * out_step + m
            store(out, o, c0)
            store(out, o + out_step, c1)
            store(out, o + 2 * out_step, c2)
            store(out, o + 3 * out_step, c3)
            store(out, o + 4 * out_step, c4)
            store(out, o + 5 * out_step, c5)
            store(out, o + 6 * out_step, c6)
            store(out, o + 7 * out_step, c7)


@helper
def add_products(
    left, left_at, left_step, inner, right, right_at, right_step, columns, rows, out, out_at
):
    """out += left^T right, (inner rounded up, columns)."""
    stay_apart()
    for m in range(0, columns, LANES):
        for k in range(0, inner, ROWS):
            o = out_at + k * columns + m
            c0 = load(out, o)
            c1 = load(out, o + columns)
            c2 = load(out, o + 2 * columns)
            c3 = load(out, o + 3 * columns)
            c4 = load(out, o + 4 * columns)
            c5 = load(out, o + 5 * columns)
            c6 = load(out, o + 6 * columns)
            c7 = load(out, o + 7 * columns)
            a = left_at + k
            b = right_at + m
            for _ in range(rows):
                row = load(right, b)
                c0 = fma(spread(left, a), row, c0)
                c1 = fma(spread(left, a + 1), row, c1)
                c2 = fma(spread(left, a + 2), row, c2)
                c3 = fma(spread(left, a + 3), row, c3)
                c4 = fma(spread(left, a + 4), row, c4)
                c5 = fma(spread(left, a + 5), row, c5)
                c6 = fma(spread(left, a + 6), row, c6)
                c7 = fma(spread(left, a + 7), row, c7)
                a += left_step
                b += right_step
            store(out, o, c0)
            store(out, o + columns, c1)
            store(out, o + 2 * columns, c2)
            store(out, o + 3 * columns, c3)
            store(out, o + 4 * columns, c4)
            store(out, o + 5 * columns, c5)
            store(out, o + 6 * columns, c6)
            store(out, o + 7 * columns, c7)


@inline
def sigmoid(x):
    """1 / (1 + exp(-x)) in every lane; NaN gives anything."""
    power = x * (-_LOG2_E)
    power = select(power < -_LARGEST, -_LARGEST, power)
    power = select(power > _LARGEST, _LARGEST, power)
    return fill(_ONE) / (exp2(power) + _ONE)


@helper
def activate(seen, at, step, columns, rows, out, to, out_step):
    """SiLU from one table to another."""
    stay_apart()
    for r in range(rows):
        for m in range(0, columns, LANES):
            x = load(seen, at + r * step + m)
            store(out, to + r * out_step + m, x * sigmoid(x))


@helper
def activate_back(seen, at, step, columns, rows, made, to, made_step, of_made, of_step):
    """SiLU again into `made`; its slope is multiplied to `of_made`."""
    stay_apart()
    for r in range(rows):
        for m in range(0, columns, LANES):
            x = load(seen, at + r * step + m)
            share = sigmoid(x)
            y = x * share
            store(made, to + r * made_step + m, y)
            i = r * of_step + m
            # NaN and infinity in x stay in y.
            store(of_made, i, load(of_made, i) * (share + y * (_ONE - share)))


@helper
def add_rows(table, first, step, columns, rows, out, at):
    """Sums of columns."""
    stay_apart()
    for m in range(0, columns, LANES):
        total = load(out, at + m)
        for r in range(rows):
            total = total + load(table, first + r * step + m)
        store(out, at + m, total)


@inline
def _whole_rows(columns, step, rows):
    """How many rows of a table may be read as whole vectors without reading behind the last."""
    behind = max(LANES - columns, 0)
    return max(rows - (behind + step - 1) // max(step, 1), 0) if behind > 0 else rows


@helper
def copy(source, at, step, columns, rows, out, to, out_step):
    """Rows of one table into another.

    Behind a row of less than 16 numbers, what follows in the source is written, too, as long as it
    belongs to one of these rows and lies there before the end of the last.
    """
    stay_apart()
    whole = _whole_rows(columns, min(step, out_step), rows)
    for r in range(whole):
        for k in range(0, columns, LANES):
            # The last vector begins where it ends with the row.
            m = max(min(k, columns - LANES), 0)
            store(out, to + r * out_step + m, load(source, at + r * step + m))
    for r in range(whole, rows):
        for k in range(columns):
            out[to + r * out_step + k] = source[at + r * step + k]


@helper
def add(source, at, step, columns, rows, out, to, out_step):
    """Rows of one table to those of another.

    Behind a row of less than 16 numbers, what follows in the source is added, too, as long as it
    belongs to one of these rows and the rows of the other table have room for it.
    """
    stay_apart()
    whole = columns // LANES * LANES
    wide = _whole_rows(columns, step, rows) if columns < LANES <= out_step else 0
    for r in range(wide):
        i = to + r * out_step
        store(out, i, load(out, i) + load(source, at + r * step))
    for r in range(wide, rows):
        for k in range(0, whole, LANES):
            i = to + r * out_step + k
            store(out, i, load(out, i) + load(source, at + r * step + k))
        for k in range(whole, columns):
            out[to + r * out_step + k] += source[at + r * step + k]


@helper
def project(table, at, step, columns, rows, weights, weights_at, out):
    """Product of each row with one vector, eight rows at a time, into `out`."""
    stay_apart()
    for r in range(0, rows, ROWS):
        a = at + r * step
        zero = fill(_ZERO)
        s0, s1, s2, s3, s4, s5, s6, s7 = zero, zero, zero, zero, zero, zero, zero, zero
        for k in range(0, columns, LANES):
            weight = load(weights, weights_at + k)
            s0 = fma(load(table, a + k), weight, s0)
            s1 = fma(load(table, a + k + step), weight, s1)
            s2 = fma(load(table, a + k + 2 * step), weight, s2)
            s3 = fma(load(table, a + k + 3 * step), weight, s3)
            s4 = fma(load(table, a + k + 4 * step), weight, s4)
            s5 = fma(load(table, a + k + 5 * step), weight, s5)
            s6 = fma(load(table, a + k + 6 * step), weight, s6)
            s7 = fma(load(table, a + k + 7 * step), weight, s7)
        store_sums(out, r, (s0, s1, s2, s3, s4, s5, s6, s7))


@helper
def add_outer(column, column_at, column_step, rows, row, row_at, columns, out, to, out_step):
    """Each row of a table gets a multiple of one vector."""
    stay_apart()
    for r in range(rows):
        factor = spread(column, column_at + r * column_step)
        for k in range(0, columns, LANES):
            i = to + r * out_step + k
            store(out, i, fma(factor, load(row, row_at + k), load(out, i)))


@helper
def add_weighted(column, column_at, column_step, rows, table, at, step, columns, out, to):
    """A vector gets the sum of a table's rows, each times a factor."""
    stay_apart()
    for k in range(0, columns, LANES):
        total = load(out, to + k)
        for r in range(rows):
            factor = spread(column, column_at + r * column_step)
            total = fma(factor, load(table, at + r * step + k), total)
        store(out, to + k, total)


#: Gaussians that one thread takes at a time, and those of them that go through all layers together.
PIECE, BLOCK = 512, 32
# The logit of the shadow coefficient is the channel behind the attributes.
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
        places: (N, C); harmonics: (B, N, L); shift: (B, point) of the first layer; hidden:
            (N, head); latent: (N, I); initial: (N, 14), all float32.
        seen: (B, N rounded up to 8, seen), filled: layers before their SiLU.
        raw: (B, N, 14); shadow: (B, N), filled.
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
