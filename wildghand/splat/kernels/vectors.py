"""Vectors of lanes inside numba: the types that the kernels are written in.

Numba has no vector type and leaves vectorisation to chance: a signed index or a branch is
enough for a loop to fall back to one lane, ten times slower. Here a vector is a value of its
own type that lowers to one LLVM vector, so the machine code is vectorised by construction
on every target (LLVM splits a vector that is wider than the registers). No fast-math flag is
set anywhere, so comparisons with NaN are false and selections by them are safe.

`float32` vectors serve blending, `float64` vectors of the same number of lanes the
projection. Only the projection may contract a product and a sum into one rounding; blending
asks for it by name with `fma`, because its forward and backward pass must agree bit for bit.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic as numba_intrinsic
from numba.extending import lower_builtin, models, register_model

#: Untyped: the types that numba declares differ between its versions.
intrinsic: Any = numba_intrinsic

#: What is declared for the CPU is asked before what is declared for every target. Numba's own
#: templates of an operator are fifty, and each that does not fit words an error.
_FIRST = {"target": "cpu"}
_LLVM = {types.float32: ir.FloatType(), types.float64: ir.DoubleType()}


class Vector(types.Type):
    """`lanes` numbers of one floating-point kind."""

    def __init__(self, element: types.Float, lanes: int) -> None:
        self.element = element
        self.lanes = lanes
        super().__init__(name=f"Vector({element}, {lanes})")

    @property
    def llvm(self) -> ir.VectorType:
        """The LLVM type."""
        return ir.VectorType(_LLVM[self.element], self.lanes)

    def constant(self, value: float) -> ir.Constant:
        """A vector with the same value in every lane."""
        return ir.Constant(self.llvm, [value] * self.lanes)


class Mask(types.Type):
    """One truth value for each lane."""

    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        super().__init__(name=f"Mask({lanes})")


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Vector) -> None:
        super().__init__(dmm, fe_type, fe_type.llvm)


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Mask) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(ir.IntType(1), fe_type.lanes))


def splat(builder: ir.IRBuilder, value: ir.Value, lanes: int) -> ir.Value:
    """One value in every lane."""
    vector = ir.VectorType(value.type, lanes)
    one = builder.insert_element(
        ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0)
    )
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
    return builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), zeros)


def shuffle(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, lanes: list[int]) -> ir.Value:
    """The named lanes of `a` followed by `b`."""
    return builder.shuffle_vector(
        a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), lanes)
    )


def widen(builder: ir.IRBuilder, value: ir.Value, kind: types.Type, vector: Vector) -> ir.Value:
    """A vector from a value that is one already or a scalar."""
    return value if isinstance(kind, Vector) else splat(builder, value, vector.lanes)


def vector_of(args: tuple[types.Type, ...]) -> Vector | None:
    """The vector type of a pair (vector, vector) or (vector, scalar of its kind)."""
    vectors = [arg for arg in args if isinstance(arg, Vector)]
    if not vectors or any(arg not in (vectors[0], vectors[0].element) for arg in args):
        return None
    return vectors[0]


def _define_operator(
    function: Callable[..., Any], emit: Callable[..., ir.Value], kind: str
) -> None:
    """Teaches numba `function` for a vector and a vector or scalar."""

    class Template(AbstractTemplate):
        metadata = _FIRST

        def generic(self, args: tuple[types.Type, ...], kws: dict[str, types.Type]) -> Any:
            vector = vector_of(args) if not kws else None
            if vector is None:
                return None
            return signature(Mask(vector.lanes) if kind == "mask" else vector, *args)

    infer_global(function)(Template)

    def lower(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        vector = vector_of(sig.args)
        assert vector is not None
        values = [
            widen(builder, value, arg, vector) for value, arg in zip(args, sig.args, strict=True)
        ]
        return emit(builder, vector, *values)

    for left, right in ((Vector, Vector), (Vector, types.Float), (types.Float, Vector)):
        lower_builtin(function, left, right)(lower)


def _arithmetic(name: str) -> Callable[..., ir.Value]:
    def emit(builder: ir.IRBuilder, vector: Vector, a: ir.Value, b: ir.Value) -> ir.Value:
        flags = ("contract",) if vector.element == types.float64 else ()
        return getattr(builder, name)(a, b, flags=flags)

    return emit


def _comparison(sign: str) -> Callable[..., ir.Value]:
    def emit(builder: ir.IRBuilder, vector: Vector, a: ir.Value, b: ir.Value) -> ir.Value:
        return builder.fcmp_ordered(sign, a, b)

    return emit


for _function, _name in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _define_operator(_function, _arithmetic(_name), "vector")
for _function, _name in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
):
    _define_operator(_function, _comparison(_name), "mask")


def _define_mask_operator(function: Callable[..., Any], name: str) -> None:
    class Template(AbstractTemplate):
        metadata = _FIRST

        def generic(self, args: tuple[types.Type, ...], kws: dict[str, types.Type]) -> Any:
            if len(args) == 2 and isinstance(args[0], Mask) and args[0] == args[1]:
                return signature(args[0], *args)
            return None

    infer_global(function)(Template)

    @lower_builtin(function, Mask, Mask)
    def lower(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return getattr(builder, name)(*args)


_define_mask_operator(operator.and_, "and_")
_define_mask_operator(operator.or_, "or_")


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


def call(builder: ir.IRBuilder, name: str, vector: Vector, values: Sequence[Any]) -> ir.Value:
    """Emits a call of an LLVM intrinsic, such as `fma`, on whole vectors."""
    kind = ir.FunctionType(vector.llvm, [vector.llvm] * len(values))
    suffix = "f32" if vector.element == types.float32 else "f64"
    function = cgutils.get_or_insert_function(
        builder.module, kind, f"llvm.{name}.v{vector.lanes}{suffix}"
    )
    return builder.call(function, values)


def make_unary(name: str) -> Callable[[Any], Any]:
    """An intrinsic that applies an LLVM intrinsic of one argument in every lane."""

    @intrinsic
    def unary(typingctx: Any, a: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
            return call(builder, name, sig.args[0], args)

        return a(a), codegen

    return unary


#: NaN below zero.
square_root = make_unary("sqrt")
absolute = make_unary("fabs")
floor = make_unary("floor")
ceil = make_unary("ceil")


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
