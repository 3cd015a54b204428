"""Operations on `simd` vectors that have no operator: loads, stores, selection, reductions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from wildghand.splat.kernels.simd import (
    Mask,
    Vector,
    intrinsic,
    shuffle,
    splat,
    vector_of,
    widen,
)

_I32 = ir.IntType(32)


def _pointer(context: Any, builder: ir.IRBuilder, kind: Any, array: Any, index: Any) -> ir.Value:
    """Address of a C-contiguous array's element, by flat index."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.gep(data, [index])


def _as_vector_pointer(builder: ir.IRBuilder, pointer: ir.Value, vector: ir.Type) -> ir.Value:
    return builder.bitcast(pointer, ir.PointerType(vector))


def make_constant(vector: Vector, values: Sequence[float]) -> Callable[[], Any]:
    """An intrinsic that returns a vector known at compile time."""
    held = tuple(float(value) for value in values)

    @intrinsic
    def constant(typingctx: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
            return ir.Constant(vector.llvm, list(held))

        return vector(), codegen

    return constant


def make_fill(vector: Vector) -> Callable[[Any], Any]:
    """An intrinsic that puts one number into every lane."""

    @intrinsic
    def fill(typingctx: Any, value: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
            return splat(builder, args[0], vector.lanes)

        return vector(vector.element), codegen

    return fill


def make_load(vector: Vector) -> Callable[[Any, Any], Any]:
    """An intrinsic that reads consecutive elements, `load(array, flat_index)`."""

    @intrinsic
    def load(typingctx: Any, array: Any, index: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
            pointer = _pointer(context, builder, sig.args[0], *args)
            return builder.load(_as_vector_pointer(builder, pointer, vector.llvm), align=4)

        return vector(array, types.intp), codegen

    return load


@intrinsic
def store(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Writes a vector over consecutive elements: `store(array, flat_index, vector)`."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1])
        builder.store(args[2], _as_vector_pointer(builder, pointer, args[2].type), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


@intrinsic
def fma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c with one rounding, in every lane; scalars are spread."""
    vector = vector_of((a, b, c))
    if vector is None:
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        values = [
            widen(builder, value, kind, vector) for value, kind in zip(args, sig.args, strict=True)
        ]
        return call(builder, "fma", vector, values)

    return vector(a, b, c), codegen


@intrinsic
def square_root(typingctx: Any, a: Any) -> Any:
    """Square root in every lane; NaN below zero."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        return call(builder, "sqrt", sig.args[0], args)

    return a(a), codegen


@intrinsic
def absolute(typingctx: Any, a: Any) -> Any:
    """Absolute value in every lane."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        return call(builder, "fabs", sig.args[0], args)

    return a(a), codegen


def call(builder: ir.IRBuilder, name: str, vector: Vector, values: Sequence[Any]) -> ir.Value:
    """Emits a call of an LLVM intrinsic, such as `fma`, on whole vectors."""
    kind = ir.FunctionType(vector.llvm, [vector.llvm] * len(values))
    suffix = "f32" if vector.element == types.float32 else "f64"
    function = cgutils.get_or_insert_function(
        builder.module, kind, f"llvm.{name}.v{vector.lanes}{suffix}"
    )
    return builder.call(function, values)


@intrinsic
def select(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """`a` in the lanes where the mask holds, `b` in the others; scalars are spread."""
    vector = vector_of((a, b))
    if not isinstance(mask, Mask) or vector is None or vector.lanes != mask.lanes:
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        yes = widen(builder, args[1], sig.args[1], vector)
        no = widen(builder, args[2], sig.args[2], vector)
        return builder.select(args[0], yes, no)

    return vector(mask, a, b), codegen


@intrinsic
def negate(typingctx: Any, a: Any) -> Any:
    """The sign turned in every lane."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        return builder.fneg(args[0])

    return a(a), codegen


@intrinsic
def bits(typingctx: Any, mask: Any) -> Any:
    """The mask as an integer, lane 0 in the lowest bit."""
    if not isinstance(mask, Mask):
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        number = builder.bitcast(args[0], ir.IntType(mask.lanes))
        return builder.zext(number, ir.IntType(64))

    return types.uint64(mask), codegen


@intrinsic
def lowest_bit(typingctx: Any, number: Any) -> Any:
    """Index of the lowest set bit of a number that is not zero."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.intp(types.uint64), codegen


@intrinsic
def count_bits(typingctx: Any, number: Any) -> Any:
    """How many bits of a number are set."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        return builder.ctpop(args[0])

    return types.intp(types.uint64), codegen


@intrinsic
def add_exponent(typingctx: Any, value: Any, shifted: Any) -> Any:
    """value * 2**n, where n sits in the low bits of `shifted` = n + 1.5 * 2**23 (float32)."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        whole = ir.VectorType(_I32, value.lanes)
        by = ir.Constant(whole, [23] * value.lanes)
        power = builder.shl(builder.bitcast(args[1], whole), by)
        return builder.bitcast(builder.add(builder.bitcast(args[0], whole), power), value.llvm)

    return value(value, value), codegen


@intrinsic
def split_exponent(typingctx: Any, value: Any) -> Any:
    """(m, n) with value = m * 2**n and m in [0.75, 1.5), for normal positive float64."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        lanes = value.lanes
        whole = ir.VectorType(ir.IntType(64), lanes)

        def const(number: int) -> ir.Constant:
            return ir.Constant(whole, [number] * lanes)

        number = builder.bitcast(args[0], whole)
        start = const(0x3FE8000000000000)  # 0.75
        exponent = builder.ashr(builder.sub(number, start), const(52))
        mantissa = builder.sub(number, builder.shl(exponent, const(52)))
        return context.make_tuple(
            builder,
            sig.return_type,
            (
                builder.bitcast(mantissa, value.llvm),
                builder.sitofp(exponent, value.llvm),
            ),
        )

    return types.UniTuple(value, 2)(value), codegen


@intrinsic
def atomic_add_one(typingctx: Any, array: Any, index: Any) -> Any:
    """Adds one to an element of an int64 array that threads share, and returns the value before."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        pointer = _pointer(context, builder, sig.args[0], *args)
        return builder.atomic_rmw("add", pointer, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(array, types.intp), codegen


@intrinsic
def prefetch(typingctx: Any, array: Any, index: Any) -> Any:
    """Asks for the cache line of an element before it is needed."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        byte = ir.IntType(8).as_pointer()
        function = builder.module.declare_intrinsic(
            "llvm.prefetch", [byte], ir.FunctionType(ir.VoidType(), [byte, _I32, _I32, _I32])
        )
        pointer = _pointer(context, builder, sig.args[0], *args)
        to_read, keep, data = (ir.Constant(_I32, value) for value in (0, 3, 1))
        builder.call(function, [builder.bitcast(pointer, byte), to_read, keep, data])
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen


@intrinsic
def narrow(typingctx: Any, a: Any) -> Any:
    """float64 lanes rounded to float32."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        return builder.fptrunc(args[0], sig.return_type.llvm)

    return Vector(types.float32, a.lanes)(a), codegen


@intrinsic
def store_sums(typingctx: Any, array: Any, index: Any, vectors: Any) -> Any:
    """Writes the sum over the lanes of each vector of a tuple to consecutive elements.

    As many elements are written as fill whole vectors; those beyond the tuple hold nothing of
    meaning. Halves are added pair by pair, so k vectors cost about 2 k shuffles rather than
    k log2(lanes), and the order of the sums is fixed.
    """
    if not isinstance(vectors, types.UniTuple) or not isinstance(vectors.dtype, Vector):
        return None
    lanes = vectors.dtype.lanes

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        rows = cgutils.unpack_tuple(builder, args[2], vectors.count)
        for first in range(0, len(rows), lanes):
            sums = _sum_rows(builder, rows[first : first + lanes], lanes)
            at = builder.add(args[1], ir.Constant(args[1].type, first))
            pointer = _pointer(context, builder, sig.args[0], args[0], at)
            builder.store(sums, _as_vector_pointer(builder, pointer, sums.type), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, vectors), codegen


def _sum_rows(builder: ir.IRBuilder, rows: list[Any], lanes: int) -> ir.Value:
    """One vector whose lane i is the sum of row i, of at most `lanes` rows."""
    width = lanes  # lanes over which one row's sum is still spread
    while width > 1:
        half = width // 2
        low: list[int] = []
        high: list[int] = []
        for first in range(0, 2 * lanes, width):
            low += range(first, first + half)
            high += range(first + half, first + width)
        pairs = [(rows[k], rows[min(k + 1, len(rows) - 1)]) for k in range(0, len(rows), 2)]
        rows = [
            builder.fadd(shuffle(builder, a, b, low), shuffle(builder, a, b, high))
            for a, b in pairs
        ]
        width = half
    return rows[0]
