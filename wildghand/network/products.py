"""Products of small matrices over many rows, compiled: what a layer does, and its gradients.

All matrices are parts of flat float32 arrays, row after row. Columns of results come in whole
vectors of 16 lanes and rows in groups of 8, so callers keep room for them.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types

from hwp_bench.base.kernels import helper
from wildghand.splat.kernels.alpha import exp2
from wildghand.splat.kernels.jit import inline
from wildghand.splat.kernels.lanes import fma, make_fill, make_load, select, store, store_sums
from wildghand.splat.kernels.simd import Vector, intrinsic, splat

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
