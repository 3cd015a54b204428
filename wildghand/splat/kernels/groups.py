"""Eight Gaussians at a time: from (N, k) float32 arrays to float64 vectors and back.

The arrays of a call hold one Gaussian after another, (x, y, z), (x, y, z)...; the projection
works on vectors (x, x, ...), (y, y, ...). Shuffles in registers do the exchange.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from wildghand.splat.kernels.jit import inline
from wildghand.splat.kernels.vectors import (
    Vector,
    intrinsic,
    make_constant,
    make_fill,
    select,
    shuffle,
    split_exponent,
)

#: Gaussians that are projected together.
GROUP = 8
#: One float64 for each of them.
EXACT = Vector(types.float64, GROUP)

_SINGLE = ir.VectorType(ir.FloatType(), GROUP)
_LARGEST = 3.4028234663852886e38

fill_exact = make_fill(EXACT)
#: 0, 1, ... 7.
lane_index = make_constant(EXACT, range(GROUP))


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any, *, floats: int) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    vector = ir.VectorType(ir.FloatType(), floats)
    return builder.bitcast(builder.gep(data, [index]), ir.PointerType(vector))


def make_load_columns(columns: int) -> Callable[[Any, Any], Any]:
    """An intrinsic `load(array, flat_index)` for 8 rows of `columns` float32.

    It gives a tuple with one float64 vector for each column.
    """

    @intrinsic
    def load_columns(typingctx: Any, array: Any, index: Any) -> Any:
        result = types.UniTuple(EXACT, columns)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
            pointer = _address(context, builder, sig.args[0], *args, floats=GROUP * columns)
            whole = builder.load(pointer, align=4)
            parts = []
            for column in range(columns):
                lanes = [row * columns + column for row in range(GROUP)]
                part = shuffle(builder, whole, whole, lanes)
                parts.append(builder.fpext(part, EXACT.llvm))
            return context.make_tuple(builder, result, parts)

        return result(array, types.intp), codegen

    return load_columns


load1, load2, load3, load4 = (make_load_columns(columns) for columns in range(1, 5))


def _saturated(builder: Any, value: ir.Value) -> ir.Value:
    """float32 of float64 lanes; values that are too large become the largest float32."""
    for sign, bound in (("<", _LARGEST), (">", -_LARGEST)):
        limit = ir.Constant(value.type, [bound] * value.type.count)
        beyond = builder.fcmp_ordered(sign, limit, value)
        value = builder.select(beyond, limit, value)
    return builder.fptrunc(value, ir.VectorType(ir.FloatType(), value.type.count))


def _joined(builder: Any, parts: list[ir.Value]) -> ir.Value:
    """One vector with the lanes of all parts, in order."""
    while len(parts) > 1:
        if len(parts) % 2:
            parts = [*parts, parts[-1]]
        wide = parts[0].type.count
        parts = [
            shuffle(builder, parts[k], parts[k + 1], list(range(2 * wide)))
            for k in range(0, len(parts), 2)
        ]
    return parts[0]


@intrinsic
def add_columns(typingctx: Any, array: Any, index: Any, values: Any) -> Any:
    """Adds a tuple of float64 vectors to 8 rows of a float32 array; saturates, never inf."""
    columns = values.count

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        pointer = _address(context, builder, sig.args[0], args[0], args[1], floats=GROUP * columns)
        together = _joined(builder, cgutils.unpack_tuple(builder, args[2]))
        lanes = [column * GROUP + row for row in range(GROUP) for column in range(columns)]
        rows = shuffle(builder, together, together, lanes)
        held = builder.fpext(builder.load(pointer, align=4), rows.type)
        builder.store(_saturated(builder, builder.fadd(held, rows)), pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, values), codegen


@intrinsic
def store_rows(typingctx: Any, array: Any, index: Any, values: Any) -> Any:
    """Writes 16 float64 vectors as 8 rows of 16 float32."""
    if not isinstance(values, types.UniTuple) or values.count != 2 * GROUP:
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        parts = [builder.fptrunc(part, _SINGLE) for part in cgutils.unpack_tuple(builder, args[2])]
        # Vector k holds values k and k + 8 of all rows; three rounds of exchanging the blocks
        # off the diagonal transpose both halves.
        rows = [
            shuffle(builder, parts[k], parts[k + GROUP], list(range(2 * GROUP)))
            for k in range(GROUP)
        ]
        for step in (4, 2, 1):
            done: list[ir.Value] = [None] * GROUP
            for k in range(GROUP):
                if k & step:
                    continue
                keep, give = [], []
                for lane in range(2 * GROUP):
                    other = 2 * GROUP
                    keep.append(other + lane - step if lane & step else lane)
                    give.append(other + lane if lane & step else lane + step)
                done[k] = shuffle(builder, rows[k], rows[k + step], keep)
                done[k + step] = shuffle(builder, rows[k], rows[k + step], give)
            rows = done
        pointer = _address(context, builder, sig.args[0], args[0], args[1], floats=2 * GROUP)
        for k, row in enumerate(rows):
            offset = ir.Constant(ir.IntType(32), k)
            builder.store(row, builder.gep(pointer, [offset]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, values), codegen


@intrinsic
def store_column(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Writes a float64 vector as 8 numbers of the array's own kind, float32 or int32."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        if array.dtype == types.float32:
            number = builder.fptrunc(args[2], _SINGLE)
        else:
            number = builder.fptosi(args[2], ir.VectorType(ir.IntType(32), GROUP))
        pointer = builder.bitcast(builder.gep(data, [args[1]]), ir.PointerType(number.type))
        builder.store(number, pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


@intrinsic
def round32(typingctx: Any, value: Any) -> Any:
    """float64 lanes rounded to the precision of float32."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        return builder.fpext(builder.fptrunc(args[0], _SINGLE), value.llvm)

    return value(value), codegen


@intrinsic
def store_pairs(typingctx: Any, array: Any, index: Any, first: Any, second: Any) -> Any:
    """Writes two float64 vectors as 8 pairs of int32."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        whole = ir.VectorType(ir.IntType(32), GROUP)
        lanes = [part * GROUP + row for row in range(GROUP) for part in range(2)]
        pairs = shuffle(
            builder, builder.fptosi(args[2], whole), builder.fptosi(args[3], whole), lanes
        )
        pointer = builder.bitcast(builder.gep(data, [args[1]]), ir.PointerType(pairs.type))
        builder.store(pairs, pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, first, second), codegen


@intrinsic
def total(typingctx: Any, value: Any) -> Any:
    """Sum of the lanes of a float64 vector, in a fixed order."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        rest, width = args[0], GROUP
        while width > 1:
            width //= 2
            low = shuffle(builder, rest, rest, list(range(width)))
            high = shuffle(builder, rest, rest, list(range(width, 2 * width)))
            rest = builder.fadd(low, high)
        return builder.extract_element(rest, ir.Constant(ir.IntType(32), 0))

    return types.float64(value), codegen


_TWO_OVER_LN2 = 2.0 / math.log(2.0)


@inline
def log2(x):
    """Base-2 logarithm in every lane, to 1e-12; x positive."""
    mantissa, exponent = split_exponent(x)
    t = (mantissa - 1.0) / (mantissa + 1.0)
    s = t * t
    series = s * (1.0 / 15.0) + 1.0 / 13.0
    series = s * series + 1.0 / 11.0
    series = s * series + 1.0 / 9.0
    series = s * series + 1.0 / 7.0
    series = s * series + 1.0 / 5.0
    series = s * series + 1.0 / 3.0
    series = s * series + 1.0
    return exponent + t * series * _TWO_OVER_LN2


@inline
def clamp(x, low, high):
    """x brought into [low, high]."""
    x = select(x < low, low, x)
    return select(x > high, high, x)


@inline
def rotation(w, x, y, z):
    """Rotation matrix of a unit quaternion, row by row."""
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz, wx, wy, wz = x * y, x * z, y * z, w * x, w * y, w * z
    one = fill_exact(1.0)
    return (
        (one - (yy + zz) * 2.0, (xy - wz) * 2.0, (xz + wy) * 2.0),
        ((xy + wz) * 2.0, one - (xx + zz) * 2.0, (yz - wx) * 2.0),
        ((xz - wy) * 2.0, (yz + wx) * 2.0, one - (xx + yy) * 2.0),
    )


@inline
def times(row, matrix):
    """Row vector times 3 x 3 matrix."""
    a, b, c = row
    m0, m1, m2 = matrix
    return (
        a * m0[0] + b * m1[0] + c * m2[0],
        a * m0[1] + b * m1[1] + c * m2[1],
        a * m0[2] + b * m1[2] + c * m2[2],
    )


@inline
def dot(a, b):
    """Inner product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline
def cross(a, b):
    """Vector product of two triples."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@inline
def scaled(row, scale):
    """Triple times triple, one by one."""
    return (row[0] * scale[0], row[1] * scale[1], row[2] * scale[2])


@inline
def plus(a, b):
    """Sum of two triples."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@inline
def by(a, number):
    """Triple times one number."""
    return (a[0] * number, a[1] * number, a[2] * number)


@inline
def keep(mask, values):
    """A triple where the mask holds, else zeros, even where it is NaN."""
    zero = fill_exact(0.0)
    return (
        select(mask, values[0], zero),
        select(mask, values[1], zero),
        select(mask, values[2], zero),
    )
