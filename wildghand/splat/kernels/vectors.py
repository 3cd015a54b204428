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

import functools
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, Signature, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

#: What is declared for the CPU is asked before what is declared for every target. Numba's own
#: templates of an operator are fifty, and each that does not fit words an error.
_FIRST = {"target": "cpu"}
_LLVM = {types.float32: ir.FloatType(), types.float64: ir.DoubleType()}
_I32, _I64 = ir.IntType(32), ir.IntType(64)


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


def shuffle(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, lanes: Sequence[int]) -> ir.Value:
    """The named lanes of `a` followed by `b`."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_I32, len(lanes)), [*lanes]))


def splat(builder: ir.IRBuilder, value: ir.Value, lanes: int) -> ir.Value:
    """One value in every lane."""
    nothing = ir.Constant(ir.VectorType(value.type, lanes), ir.Undefined)
    one = builder.insert_element(nothing, value, ir.Constant(_I32, 0))
    return shuffle(builder, one, nothing, [0] * lanes)


def vector_of(args: tuple[types.Type, ...]) -> Vector | None:
    """The vector type of vectors and scalars of its kind; None if there is none."""
    vectors = [arg for arg in args if isinstance(arg, Vector)]
    if not vectors or any(arg not in (vectors[0], vectors[0].element) for arg in args):
        return None
    return vectors[0]


def widen(
    builder: ir.IRBuilder, vector: Vector, values: Iterable[ir.Value], kinds: Iterable[types.Type]
) -> list[ir.Value]:
    """Vectors from values that are vectors already or scalars."""
    return [
        value if isinstance(kind, Vector) else splat(builder, value, vector.lanes)
        for value, kind in zip(values, kinds, strict=True)
    ]


def call(builder: ir.IRBuilder, name: str, vector: Vector, values: Sequence[Any]) -> ir.Value:
    """Emits a call of an LLVM intrinsic, such as `fma`, on whole vectors."""
    kind = ir.FunctionType(vector.llvm, [vector.llvm] * len(values))
    suffix = "f32" if vector.element == types.float32 else "f64"
    full = f"llvm.{name}.v{vector.lanes}{suffix}"
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, full), values)


def _teach(
    function: Callable[..., Any],
    pairs: Iterable[tuple[type, type]],
    result: Callable[..., types.Type | None],
    emit: Callable[..., ir.Value],
) -> None:
    """Teaches numba an operator for pairs of kinds of operands."""

    class Template(AbstractTemplate):
        metadata = _FIRST

        def generic(self, args: tuple[types.Type, ...], kws: dict[str, types.Type]) -> Any:
            kind = None if kws or len(args) != 2 else result(*args)
            return None if kind is None else signature(kind, *args)

    infer_global(function)(Template)

    def lower(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        vector = vector_of(sig.args)
        if vector is None:
            return emit(builder, *args)
        # Only the projection is in float64, and only it may contract.
        flags = ("contract",) if vector.element == types.float64 else ()
        return emit(builder, *widen(builder, vector, args, sig.args), flags=flags)

    for left, right in pairs:
        lower_builtin(function, left, right)(lower)


_NUMBERS = ((Vector, Vector), (Vector, types.Float), (types.Float, Vector))


def _mask_of(*args: types.Type) -> Mask | None:
    vector = vector_of(args)
    return None if vector is None else Mask(vector.lanes)


def _compare(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, sign: str, flags: Any) -> ir.Value:
    return builder.fcmp_ordered(sign, a, b)


for _name, _emit in (
    ("add", ir.IRBuilder.fadd),
    ("sub", ir.IRBuilder.fsub),
    ("mul", ir.IRBuilder.fmul),
    ("truediv", ir.IRBuilder.fdiv),
):
    _teach(getattr(operator, _name), _NUMBERS, lambda *args: vector_of(args), _emit)
for _name, _sign in (("lt", "<"), ("le", "<="), ("gt", ">"), ("ge", ">=")):
    _teach(getattr(operator, _name), _NUMBERS, _mask_of, functools.partial(_compare, sign=_sign))
for _name, _emit in (("and_", ir.IRBuilder.and_), ("or_", ir.IRBuilder.or_)):
    _teach(
        getattr(operator, _name),
        [(Mask, Mask)],
        lambda a, b: a if isinstance(a, Mask) and a == b else None,
        _emit,
    )


class LoweredCall(NamedTuple):
    """A call of an intrinsic that is being lowered."""

    context: Any
    builder: ir.IRBuilder
    sig: Any

    def place(self, array: Any, index: Any, vector: ir.Type | None = None) -> ir.Value:
        """Address of an element of the first argument, by flat index; as that of a vector."""
        data = self.context.make_array(self.sig.args[0])(self.context, self.builder, array).data
        pointer = self.builder.gep(data, [index])
        return pointer if vector is None else self.builder.bitcast(pointer, vector.as_pointer())

    def load(self, array: Any, index: Any, vector: ir.Type) -> ir.Value:
        """A vector of consecutive elements."""
        return self.builder.load(self.place(array, index, vector), align=4)

    def store(self, array: Any, index: Any, value: ir.Value) -> None:
        """Write a vector over consecutive elements."""
        self.builder.store(value, self.place(array, index, value.type), align=4)

    def unpack(self, values: ir.Value) -> list[ir.Value]:
        """The values of a tuple."""
        return cgutils.unpack_tuple(self.builder, values)

    def pack(self, values: Sequence[ir.Value]) -> ir.Value:
        """The tuple that is returned."""
        return self.context.make_tuple(self.builder, self.sig.return_type, values)


def lowered(result: Callable[..., Any]) -> Callable[[Callable[..., Any]], Any]:
    """Decorator: an intrinsic, whose function emits the code from a `LoweredCall` and the values.

    Args:
        result: from the types of the arguments, that of the value, or a signature, or None where
            they do not fit. Where only the type is given, integers are taken as indices.
    """

    def define(emit: Callable[..., Any]) -> Any:
        @functools.wraps(emit)
        def typed(typingctx: Any, *args: Any) -> Any:
            sig = result(*args)
            if sig is None:
                return None
            if not isinstance(sig, Signature):
                sig = sig(*(types.intp if isinstance(a, types.Integer) else a for a in args))

            def codegen(context: Any, builder: Any, sig: Any, values: Any) -> ir.Value:
                made = emit(LoweredCall(context, builder, sig), *values)
                return context.get_dummy_value() if made is None else made

            return sig, codegen

        return intrinsic(typed)

    return define


def _nothing(*args: types.Type) -> types.Type:
    return types.void


def make_constant(vector: Vector, values: Iterable[float]) -> Any:
    """An intrinsic that returns a vector known at compile time."""
    held = [float(value) for value in values]

    @lowered(lambda: vector)
    def constant(code: LoweredCall) -> ir.Value:
        return ir.Constant(vector.llvm, held)

    return constant


def make_fill(vector: Vector) -> Any:
    """An intrinsic that puts one number into every lane."""

    @lowered(lambda value: vector(vector.element))
    def fill(code: LoweredCall, value: Any) -> ir.Value:
        return splat(code.builder, value, vector.lanes)

    return fill


def make_load(vector: Vector) -> Any:
    """An intrinsic that reads consecutive elements, `load(array, flat_index)`."""

    @lowered(lambda array, index: vector)
    def load(code: LoweredCall, array: Any, index: Any) -> ir.Value:
        return code.load(array, index, vector.llvm)

    return load


@lowered(_nothing)
def store(code: LoweredCall, array: Any, index: Any, value: Any) -> None:
    """Writes a vector over consecutive elements: `store(array, flat_index, vector)`."""
    code.store(array, index, value)


@lowered(lambda a, b, c: vector_of((a, b, c)))
def fma(code: LoweredCall, a: Any, b: Any, c: Any) -> ir.Value:
    """a * b + c with one rounding, in every lane; scalars are spread."""
    vector = code.sig.return_type
    return call(code.builder, "fma", vector, widen(code.builder, vector, (a, b, c), code.sig.args))


@lowered(lambda array, index, stride, weight, sums: sums)
def add_lines(
    code: LoweredCall, array: Any, index: Any, stride: Any, weight: Any, sums: Any
) -> ir.Value:
    """`sums`, to each of which weight times a vector is added; the vectors are `stride` apart."""
    vector, made = code.sig.return_type.dtype, []
    (weight,) = widen(code.builder, vector, [weight], code.sig.args[3:4])
    for total in code.unpack(sums):
        made.append(
            call(code.builder, "fma", vector, [weight, code.load(array, index, vector.llvm), total])
        )
        index = code.builder.add(index, stride)
    return code.pack(made)


@lowered(_nothing)
def store_lines(code: LoweredCall, array: Any, index: Any, stride: Any, values: Any) -> None:
    """Writes the vectors of a tuple, `stride` apart."""
    for value in code.unpack(values):
        code.store(array, index, value)
        index = code.builder.add(index, stride)


def _make_unary(name: str) -> Any:
    """An intrinsic that applies an LLVM intrinsic of one argument in every lane."""

    @lowered(lambda a: a)
    def unary(code: LoweredCall, a: Any) -> ir.Value:
        return call(code.builder, name, code.sig.return_type, [a])

    return unary


#: NaN below zero.
square_root = _make_unary("sqrt")
absolute = _make_unary("fabs")
floor = _make_unary("floor")
ceil = _make_unary("ceil")


@lowered(
    lambda mask, a, b: (
        vector_of((a, b)) if isinstance(mask, Mask) and _mask_of(a, b) == mask else None
    )
)
def select(code: LoweredCall, mask: Any, a: Any, b: Any) -> ir.Value:
    """`a` in the lanes where the mask holds, `b` in the others; scalars are spread."""
    yes, no = widen(code.builder, code.sig.return_type, (a, b), code.sig.args[1:])
    return code.builder.select(mask, yes, no)


@lowered(lambda mask, values: values)
def keep(code: LoweredCall, mask: Any, values: Any) -> ir.Value:
    """A tuple of vectors where the mask holds, else zeros, even where it is NaN."""
    zero = code.sig.return_type.dtype.constant(0.0)
    return code.pack([code.builder.select(mask, value, zero) for value in code.unpack(values)])


@lowered(lambda a: a)
def negate(code: LoweredCall, a: Any) -> ir.Value:
    """The sign turned in every lane."""
    return code.builder.fneg(a)


@lowered(lambda mask: types.uint64 if isinstance(mask, Mask) else None)
def bits(code: LoweredCall, mask: Any) -> ir.Value:
    """The mask as an integer, lane 0 in the lowest bit."""
    number = code.builder.bitcast(mask, ir.IntType(code.sig.args[0].lanes))
    return code.builder.zext(number, _I64)


@lowered(lambda number: types.intp(types.uint64))
def lowest_bit(code: LoweredCall, number: Any) -> ir.Value:
    """Index of the lowest set bit of a number that is not zero."""
    return code.builder.cttz(number, ir.Constant(ir.IntType(1), 1))


@lowered(lambda number: types.intp(types.uint64))
def count_bits(code: LoweredCall, number: Any) -> ir.Value:
    """How many bits of a number are set."""
    return code.builder.ctpop(number)


@lowered(lambda value, shifted: value)
def add_exponent(code: LoweredCall, value: Any, shifted: Any) -> ir.Value:
    """value * 2**n, where n sits in the low bits of `shifted` = n + 1.5 * 2**23 (float32)."""
    builder, whole = code.builder, ir.VectorType(_I32, value.type.count)
    by = ir.Constant(whole, [23] * value.type.count)
    power = builder.shl(builder.bitcast(shifted, whole), by)
    return builder.bitcast(builder.add(builder.bitcast(value, whole), power), value.type)


@lowered(lambda value: types.UniTuple(value, 2))
def split_exponent(code: LoweredCall, value: Any) -> ir.Value:
    """(m, n) with value = m * 2**n and m in [0.75, 1.5), for normal positive float64."""
    builder, lanes = code.builder, value.type.count
    whole = ir.VectorType(_I64, lanes)
    start, shift = (ir.Constant(whole, [n] * lanes) for n in (0x3FE8000000000000, 52))  # 0.75
    number = builder.bitcast(value, whole)
    exponent = builder.ashr(builder.sub(number, start), shift)
    mantissa = builder.sub(number, builder.shl(exponent, shift))
    return code.pack([builder.bitcast(mantissa, value.type), builder.sitofp(exponent, value.type)])


@lowered(lambda array, index: types.int64)
def atomic_add_one(code: LoweredCall, array: Any, index: Any) -> ir.Value:
    """Adds one to an element of an int64 array that threads share, and returns the value before."""
    place = code.place(array, index)
    return code.builder.atomic_rmw("add", place, ir.Constant(_I64, 1), "monotonic")


@lowered(_nothing)
def prefetch(code: LoweredCall, array: Any, index: Any) -> None:
    """Asks for the cache line of an element before it is needed."""
    byte = ir.IntType(8).as_pointer()
    function = code.builder.module.declare_intrinsic(
        "llvm.prefetch", [byte], ir.FunctionType(ir.VoidType(), [byte, _I32, _I32, _I32])
    )
    pointer = code.builder.bitcast(code.place(array, index), byte)
    to_read, held, data = (ir.Constant(_I32, value) for value in (0, 3, 1))
    code.builder.call(function, [pointer, to_read, held, data])


@lowered(lambda a: Vector(types.float32, a.lanes))
def narrow(code: LoweredCall, a: Any) -> ir.Value:
    """float64 lanes rounded to float32."""
    return code.builder.fptrunc(a, code.sig.return_type.llvm)


@lowered(
    lambda array, index, vectors: (
        types.void
        if isinstance(vectors, types.UniTuple) and isinstance(vectors.dtype, Vector)
        else None
    )
)
def store_sums(code: LoweredCall, array: Any, index: Any, vectors: Any) -> None:
    """Writes the sum over the lanes of each vector of a tuple to consecutive elements.

    As many elements are written as fill whole vectors; those beyond the tuple hold nothing of
    meaning. Halves are added pair by pair, so k vectors cost about 2 k shuffles rather than
    k log2(lanes), and the order of the sums is fixed.
    """
    rows, lanes = code.unpack(vectors), code.sig.args[2].dtype.lanes
    for first in range(0, len(rows), lanes):
        sums = _sum_rows(code.builder, rows[first : first + lanes], lanes)
        code.store(array, code.builder.add(index, ir.Constant(index.type, first)), sums)


def _sum_rows(builder: ir.IRBuilder, rows: list[Any], lanes: int) -> ir.Value:
    """One vector whose lane i is the sum of row i, of at most `lanes` rows."""
    width = lanes  # lanes over which one row's sum is still spread
    while width > 1:
        half = width // 2
        starts = range(0, 2 * lanes, width)
        low, high = (
            [lane for start in starts for lane in range(start + skip, start + skip + half)]
            for skip in (0, half)
        )
        pairs = [(rows[k], rows[min(k + 1, len(rows) - 1)]) for k in range(0, len(rows), 2)]
        rows = [
            builder.fadd(shuffle(builder, a, b, low), shuffle(builder, a, b, high))
            for a, b in pairs
        ]
        width = half
    return rows[0]
