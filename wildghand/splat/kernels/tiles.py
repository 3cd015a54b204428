"""A splat as a tile of pixels sees it: its row of numbers, its alpha, its channels.

A splat is a small blob. A vector of pixels shaped as a block (4 x 4 rather than 16 x 1) misses
it less often, so fewer lanes are wasted. Each tile has 16 blocks, so that one 16-lane vector
says which blocks of a tile a splat can reach.

Of each Gaussian tiles need one row of 16 float32, one cache line.

A projected Gaussian is kept as its exponent is evaluated. With e the distance across pixel rows
and u the distance along the row from the splat's centre line, both scaled,

    log2(alpha) = log2(opacity) - e^2 - u^2
    e = across * dy,   u = along * (dx + shear * dy)

which is the Cholesky form of the inverse covariance. Both squares stay small wherever the splat
is visible, so a needle hundreds of pixels long loses no digits in float32; the usual
a dx^2 + 2 b dx dy + c dy^2 loses all of them. Centre and shear are pairs of float32 (value
and rounding error) because the distance to a pixel is a difference of nearly equal numbers.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from typing import Any

import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import config
from numba.extending import overload

from wildghand.splat import conventions as rules
from wildghand.splat.kernels.jit import inline
from wildghand.splat.kernels.vectors import (
    LoweredCall,
    Vector,
    absolute,
    add_exponent,
    add_lines,
    bits,
    fma,
    lowered,
    make_constant,
    make_fill,
    make_load,
    narrow,
    negate,
    prefetch,
    select,
    store,
    store_sums,
)

#: Floats in a row.
ROW = 16
MEAN_X, MEAN_Y, MEAN_X_LOW, MEAN_Y_LOW, SHEAR, SHEAR_LOW, ALONG, ACROSS = range(8)
#: log2 of the opacity.
LOG2_OPACITY = 8
#: Half the size in pixels of the box around the visible part.
REACH_X, REACH_Y = 9, 10
#: dy of the visible part's rightmost point; its leftmost has the opposite.
TANGENT_Y = 11
#: First row of tiles that it touches, and how many.
FIRST_ROW, ROWS = 12, 13


def _lanes() -> int:
    """float32 lanes of the widest registers of the processor that numba compiles for."""
    features = getattr(config, "CPU_FEATURES", None)  # of NUMBA_CPU_FEATURES
    if features is None:
        try:
            features = llvmlite.binding.get_host_cpu_features().flatten()
        except RuntimeError:  # not every platform can tell
            features = ""
    return 16 if "+avx512f" in features and "+avx512vl" in features else 8


#: Pixels in a block: one vector.
LANES = _lanes()
#: Blocks in a tile.
BLOCKS = 16
#: Shape of a block in pixels.
BLOCK_WIDTH, BLOCK_HEIGHT = (4, 4) if LANES == 16 else (4, 2)
#: Blocks side by side in a tile.
BLOCK_COLUMNS = 4
#: Shape of a tile in pixels.
TILE_WIDTH = BLOCK_COLUMNS * BLOCK_WIDTH
TILE_HEIGHT = BLOCKS // BLOCK_COLUMNS * BLOCK_HEIGHT

#: A vector with one lane for each pixel of a block.
PIXELS = Vector(types.float32, LANES)
#: A vector with one lane for each block of a tile.
PER_BLOCK_EXACT = Vector(types.float64, BLOCKS)

fill_pixels = make_fill(PIXELS)
load_pixels = make_load(PIXELS)
#: Column and row of each pixel in its block.
pixel_column = make_constant(PIXELS, [lane % BLOCK_WIDTH for lane in range(LANES)])
pixel_row = make_constant(PIXELS, [lane // BLOCK_WIDTH for lane in range(LANES)])
#: Column and row in its tile of each block's first pixel.
block_column = make_constant(
    PER_BLOCK_EXACT, [block % BLOCK_COLUMNS * BLOCK_WIDTH for block in range(BLOCKS)]
)
block_row = make_constant(
    PER_BLOCK_EXACT, [block // BLOCK_COLUMNS * BLOCK_HEIGHT for block in range(BLOCKS)]
)

#: log2 of the alpha at which a splat ends, and of the largest alpha.
LOG2_MIN_ALPHA = np.float32(math.log2(rules.MIN_ALPHA))
LOG2_MAX_ALPHA = np.float32(math.log2(rules.MAX_ALPHA))
MIN_TRANSMITTANCE = np.float32(rules.MIN_TRANSMITTANCE)
ZERO, ONE = np.float32(0.0), np.float32(1.0)
#: Slack, in log2(alpha), of the test that skips blocks; only adds blocks that blend nothing.
_SLACK = np.float32(1e-3)
_HALF_WIDTH = np.float32((BLOCK_WIDTH - 1) / 2)
_HALF_HEIGHT = np.float32((BLOCK_HEIGHT - 1) / 2)
#: Entries that are prepared together.
BATCH = 16
#: The half of an entry that names its Gaussian (see `lists.fill_tiles`).
GAUSSIAN = np.uint64(0xFFFFFFFF)
_ROUND = np.float32(1.5 * 2**23)


def _exp2_coefficients(degree: int = 5) -> list[np.float32]:
    """Polynomial for 2^x on [-1/2, 1/2] with the smallest relative error (Lawson's iteration)."""
    count = 400
    x = 0.5 * np.cos(np.pi * (np.arange(count) + 0.5) / count)
    powers, truth = np.vander(x, degree + 1, increasing=True), np.exp2(x)
    weights = np.ones(count)
    for _ in range(60):
        root = np.sqrt(weights) / truth
        fit = np.linalg.lstsq(powers * root[:, None], truth * root, rcond=None)[0]
        error = np.abs(powers @ fit / truth - 1)
        weights *= error
        weights /= weights.sum()
    return [np.float32(value) for value in fit]


_E0, _E1, _E2, _E3, _E4, _E5 = _exp2_coefficients()


@inline
def exp2(x):
    """2**x in every lane, to 3e-7; x in [-126, 126], anything elsewhere."""
    shifted = x + _ROUND
    fraction = x - (shifted - _ROUND)
    power = fma(fraction, _E5, _E4)
    power = fma(power, fraction, _E3)
    power = fma(power, fraction, _E2)
    power = fma(power, fraction, _E1)
    power = fma(power, fraction, _E0)
    return add_exponent(power, shifted)


@inline
def enter_tile(geom, row, tile_x, tile_y, offsets, to):
    """A splat relative to a tile.

    Writes u and e (see `geometry`) of the first pixel of each block to `offsets` from `to` on,
    first all u, then all e.

    Args:
        tile_x, tile_y: centre of the tile's first pixel, px.
        offsets: float32.
    """
    along = geom[row + ALONG]
    across = geom[row + ACROSS]
    exact_along = np.float64(along)
    x = np.float64(geom[row + MEAN_X]) - tile_x + np.float64(geom[row + MEAN_X_LOW])
    y = np.float64(geom[row + MEAN_Y]) - tile_y + np.float64(geom[row + MEAN_Y_LOW])
    shear = np.float64(geom[row + SHEAR]) + np.float64(geom[row + SHEAR_LOW])
    exact_slope = exact_along * shear
    start = -(exact_along * x + exact_slope * y)
    u = narrow(block_column() * exact_along + (block_row() * exact_slope + start))
    e = narrow((block_row() - y) * np.float64(across))
    store(offsets, to, u)
    store(offsets, to + BLOCKS, e)
    # A block is a parallelogram in (u, e); its bounding box must meet the splat's disc.
    slope = np.float32(exact_slope)
    u_half = along * _HALF_WIDTH + abs(slope) * _HALF_HEIGHT
    e_half = across * _HALF_HEIGHT
    u_gap = absolute(u + (along * _HALF_WIDTH + slope * _HALF_HEIGHT)) - u_half
    e_gap = absolute(e + e_half) - e_half
    u_gap = select(u_gap > ZERO, u_gap, ZERO)
    e_gap = select(e_gap > ZERO, e_gap, ZERO)
    reach = geom[row + LOG2_OPACITY] - LOG2_MIN_ALPHA + _SLACK
    return bits(fma(u_gap, u_gap, e_gap * e_gap) <= reach), slope


@inline
def enter_batch(geom, base, entries, start, stop, last, left, top, alive, work):
    """`enter_tile` for the entries from `start` to `stop`, ahead of blending them.

    Were each splat blended right away, the processor would guess wrongly how many blocks it has
    and wait for this arithmetic every time.
    """
    for k in range(start, stop):
        if k + BATCH < last:
            prefetch(geom, (base + np.int64(entries[k + BATCH] & GAUSSIAN)) * ROW)
        i = k - start
        g = np.int64(entries[k] & GAUSSIAN)
        inside, slope = enter_tile(
            geom, (base + g) * ROW, left + 0.5, top + 0.5, work.offsets, 2 * BLOCKS * i
        )
        work.blocks[i] = inside & alive
        work.ids[i] = g
        work.slopes[i] = slope


@inline
def relative_pixels(geom, row, slope):
    """u and e of the pixels of a block, relative to its first."""
    u = fma(pixel_row(), slope, pixel_column() * geom[row + ALONG])
    return u, pixel_row() * geom[row + ACROSS]


@inline
def log2_alpha(u, e, opacity):
    """log2(alpha), before it is clamped."""
    return fma(negate(u), u, fma(negate(e), e, opacity))


@inline
def clamped_alpha(power):
    """Alpha from log2(alpha)."""
    return exp2(select(power < LOG2_MAX_ALPHA, power, LOG2_MAX_ALPHA))


@inline
def alive_blocks(state, stride):
    """The blocks of a tile that still have a pixel to blend, as bits.

    The first vector of each block's `stride` floats is its transmittance, kept negative from
    where the pixel takes nothing more.
    """
    alive = np.uint64(0)
    for b in range(BLOCKS):
        if bits(load_pixels(state, b * stride) > ZERO) != 0:
            alive |= np.uint64(1) << np.uint64(b)
    return alive


@inline
def scratch(size):
    """float32 memory of one thread, on a cache line."""
    memory = np.empty(size + 16, np.float32)
    skip = (-(np.int64(memory.ctypes.data) >> 2)) & 15
    return memory[skip : skip + size]


@inline
def place_of(x, y):
    """Block and lane of a pixel of a tile."""
    block = y // BLOCK_HEIGHT * BLOCK_COLUMNS + x // BLOCK_WIDTH
    return block, y % BLOCK_HEIGHT * BLOCK_WIDTH + x % BLOCK_WIDTH


# Work over colour channels, twice: unrolled in registers, or as a loop of any length. `channels`
# says which. A tuple of D zeros fixes D when the kernel is compiled, and colours and gradients live
# in registers: the path of RGB. A plain number is a loop over memory, one compiled kernel for every
# D. The kernels are written once against the functions here.

#: Sums over pixels that the geometry's gradient needs, besides one for each channel.
MOMENTS = 6


def _fixed(channels: Any) -> bool:
    return isinstance(channels, types.BaseTuple)


def count(channels):
    """The number of channels, a constant where it is fixed."""


@overload(count)
def _count(channels):
    if _fixed(channels):
        number = len(channels)
        return lambda channels: number
    return lambda channels: channels


@lowered(lambda array, index, channels: types.UniTuple(array.dtype, channels.count))
def _load_tuple(code: LoweredCall, array: Any, index: Any, channels: Any) -> ir.Value:
    builder = code.builder
    places = [builder.add(index, ir.Constant(index.type, k)) for k in range(channels.type.count)]
    return code.pack([builder.load(code.place(array, place)) for place in places])


def fetch(colors, index, channels):
    """The colour that starts at a flat index, to be handed to `channel`."""


@overload(fetch)
def _fetch(colors, index, channels):
    if _fixed(channels):
        return lambda colors, index, channels: _load_tuple(colors, index, channels)
    return lambda colors, index, channels: index


def channel(colors, color, k):
    """One channel of a colour that was fetched."""


@overload(channel)
def _channel(colors, color, k):
    if _fixed(color):
        return lambda colors, color, k: color[k]
    return lambda colors, color, k: colors[color + k]


@inline
def paint(state, at, weight, colors, color, channels):
    """Adds weight * colour to the channels of a block; `at` is its first channel's vector."""
    for k in range(count(channels)):
        place = at + k * LANES
        store(state, place, fma(weight, channel(colors, color, k), load_pixels(state, place)))


@inline
def project(state, at, colors, color, channels):
    """Sum over channels of colour * upstream gradient, for the pixels of a block."""
    total = load_pixels(state, at) * channel(colors, color, 0)
    for k in range(1, count(channels)):
        total = fma(load_pixels(state, at + k * LANES), channel(colors, color, k), total)
    return total


@lowered(lambda channels: types.UniTuple(PIXELS, channels.count))
def _zero_tuple(code: LoweredCall, channels: Any) -> ir.Value:
    return code.pack([PIXELS.constant(0.0)] * channels.type.count)


def start_sums(sums, channels):
    """Sums of a splat's colour gradient, at zero; `sums` is scratch for the loop."""


@overload(start_sums)
def _start_sums(sums, channels):
    if _fixed(channels):
        return lambda sums, channels: _zero_tuple(channels)

    def loop(sums, channels):
        for k in range(channels):
            store(sums, k * LANES, fill_pixels(ZERO))
        return sums

    return loop


def add_to_sums(sums, weight, state, at):
    """Adds weight * upstream gradient of a block to the sums, and returns them."""


@overload(add_to_sums)
def _add_to_sums(sums, weight, state, at):
    if _fixed(sums):
        return lambda sums, weight, state, at: add_lines(state, at, LANES, weight, sums)

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
    if _fixed(sums):
        return lambda slots, at, moments, sums: store_sums(slots, at, moments + sums)

    def loop(slots, at, moments, sums):
        store_sums(slots, at, moments)
        for k in range(sums.size // LANES):
            store_sums(slots, at + MOMENTS + k, (load_pixels(sums, k * LANES),))

    return loop


def slot_size(channels: int, fixed: bool) -> int:
    """Floats that `finish_sums` writes for one splat in one tile."""
    if fixed:
        return -(-(MOMENTS + channels) // LANES) * LANES
    return MOMENTS + channels - 1 + LANES
