"""Work over colour channels, twice: unrolled in registers, or as a loop of any length.

`channels` says which. A tuple of D zeros fixes D when the kernel is compiled, and colours and
their gradients live in registers: the path of RGB. A plain number is a loop over memory, one
compiled kernel for every D. The kernels are written once against the functions here.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import overload

from wildghand.splat.kernels.lanes import fma, store, store_sums
from wildghand.splat.kernels.simd import intrinsic
from wildghand.splat.kernels.tiles import LANES, PIXELS, fill_pixels, load_pixels

_ZERO = np.float32(0.0)
#: Sums over pixels that the geometry's gradient needs, besides one for each channel.
MOMENTS = 6


def _fixed(channels: Any) -> bool:
    return isinstance(channels, types.BaseTuple)


def count(channels):
    """How many channels: a constant where they are fixed."""


@overload(count)
def _count(channels):
    if _fixed(channels):
        number = len(channels)
        return lambda channels: number
    return lambda channels: channels


@intrinsic
def _load_tuple(typingctx: Any, array: Any, index: Any, channels: Any) -> Any:
    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        values = []
        for k in range(channels.count):
            at = builder.add(args[1], ir.Constant(args[1].type, k))
            values.append(builder.load(builder.gep(data, [at])))
        return context.make_tuple(builder, sig.return_type, values)

    return types.UniTuple(array.dtype, channels.count)(array, types.intp, channels), codegen


def fetch(colors, index, channels):
    """The colour that starts at a flat index, to be handed to `paint` and `project`."""


@overload(fetch)
def _fetch(colors, index, channels):
    if _fixed(channels):
        return lambda colors, index, channels: _load_tuple(colors, index, channels)
    return lambda colors, index, channels: index


def paint(state, at, weight, colors, color, channels):
    """Adds weight * colour to the channels of a block; `at` is its first channel's vector."""


@overload(paint)
def _paint(state, at, weight, colors, color, channels):
    if _fixed(channels):

        def fixed(state, at, weight, colors, color, channels):
            for k in range(len(color)):
                place = at + k * LANES
                store(state, place, fma(weight, color[k], load_pixels(state, place)))

        return fixed

    def loop(state, at, weight, colors, color, channels):
        for k in range(channels):
            place = at + k * LANES
            store(state, place, fma(weight, colors[color + k], load_pixels(state, place)))

    return loop


def project(state, at, colors, color, channels):
    """Sum over channels of colour * upstream gradient, for the pixels of a block."""


@overload(project)
def _project(state, at, colors, color, channels):
    if _fixed(channels):

        def fixed(state, at, colors, color, channels):
            total = load_pixels(state, at) * color[0]
            for k in range(1, len(color)):
                total = fma(load_pixels(state, at + k * LANES), color[k], total)
            return total

        return fixed

    def loop(state, at, colors, color, channels):
        total = fill_pixels(_ZERO)
        for k in range(channels):
            total = fma(load_pixels(state, at + k * LANES), colors[color + k], total)
        return total

    return loop


@intrinsic
def _zero_tuple(typingctx: Any, channels: Any) -> Any:
    kind = types.UniTuple(PIXELS, channels.count)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        return context.make_tuple(builder, kind, [PIXELS.constant(0.0)] * channels.count)

    return kind(channels), codegen


@intrinsic
def _gather_tuple(typingctx: Any, sums: Any, weight: Any, state: Any, at: Any) -> Any:
    """sums[k] + weight * (vector k of state)."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        data = context.make_array(sig.args[2])(context, builder, args[2]).data
        vector = PIXELS.llvm
        function = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(vector, [vector] * 3),
            f"llvm.fma.v{PIXELS.lanes}f32",
        )
        values = []
        for k, total in enumerate(cgutils.unpack_tuple(builder, args[0], sums.count)):
            place = builder.add(args[3], ir.Constant(args[3].type, k * PIXELS.lanes))
            pointer = builder.bitcast(builder.gep(data, [place]), ir.PointerType(vector))
            upstream = builder.load(pointer, align=4)
            values.append(builder.call(function, [args[1], upstream, total]))
        return context.make_tuple(builder, sums, values)

    return sums(sums, weight, state, types.intp), codegen


def start_sums(sums, channels):
    """Sums of a splat's colour gradient, at zero; `sums` is scratch for the loop."""


@overload(start_sums)
def _start_sums(sums, channels):
    if _fixed(channels):
        return lambda sums, channels: _zero_tuple(channels)

    def loop(sums, channels):
        for k in range(channels):
            store(sums, k * LANES, fill_pixels(_ZERO))
        return sums

    return loop


def add_to_sums(sums, weight, state, at):
    """Adds weight * upstream gradient of a block to the sums, and returns them."""


@overload(add_to_sums)
def _add_to_sums(sums, weight, state, at):
    if isinstance(sums, types.BaseTuple):
        return lambda sums, weight, state, at: _gather_tuple(sums, weight, state, at)

    def loop(sums, weight, state, at):
        for k in range(sums.size // LANES):
            total = load_pixels(sums, k * LANES)
            store(sums, k * LANES, fma(weight, load_pixels(state, at + k * LANES), total))
        return sums

    return loop


def finish_sums(slots, at, moments, sums):
    """Writes the sums over all lanes: the moments first, then each channel."""


@overload(finish_sums)
def _finish_sums(slots, at, moments, sums):
    if isinstance(sums, types.BaseTuple):
        return lambda slots, at, moments, sums: store_sums(slots, at, moments + sums)

    def loop(slots, at, moments, sums):
        store_sums(slots, at, moments)
        place = at + MOMENTS
        for k in range(sums.size // LANES):
            store_sums(slots, place + k, (load_pixels(sums, k * LANES),))

    return loop


def slot_size(channels: int, fixed: bool) -> int:
    """Floats that `finish_sums` writes for one splat in one tile."""
    if fixed:
        return -(-(MOMENTS + channels) // LANES) * LANES
    return MOMENTS + channels - 1 + LANES
