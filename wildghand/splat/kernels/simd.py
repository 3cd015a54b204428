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
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
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
