"""Alpha of a splat over the pixels of a block: shared by the forward and the backward pass."""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from wildghand.splat.kernels import geometry as at
from wildghand.splat.kernels.jit import inline
from wildghand.splat.kernels.lanes import (
    absolute,
    add_exponent,
    bits,
    fma,
    narrow,
    negate,
    prefetch,
    select,
    store,
)
from wildghand.splat.kernels.tiles import (
    BLOCK_COLUMNS,
    BLOCK_HEIGHT,
    BLOCK_WIDTH,
    BLOCKS,
    LOG2_MAX_ALPHA,
    LOG2_MIN_ALPHA,
    block_column,
    block_row,
    load_pixels,
    pixel_column,
    pixel_row,
)

_ZERO = np.float32(0.0)
#: Slack, in log2(alpha), of the test that skips blocks; only adds blocks that blend nothing.
_SLACK = np.float32(1e-3)
_HALF_WIDTH = np.float32((BLOCK_WIDTH - 1) / 2)
_HALF_HEIGHT = np.float32((BLOCK_HEIGHT - 1) / 2)
#: Entries that are prepared together.
BATCH = 16
#: The half of an entry that names its Gaussian (see `bins.fill_tiles`).
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
        geom, row: the splat.
        tile_x, tile_y: centre of the tile's first pixel, px.
        offsets: float32.
        to: where to write.

    Returns:
        The blocks that the splat may reach, as bits; du/dy, by which u changes from one row of
        pixels to the next.
    """
    along = geom[row + at.ALONG]
    across = geom[row + at.ACROSS]
    exact_along = np.float64(along)
    x = np.float64(geom[row + at.MEAN_X]) - tile_x + np.float64(geom[row + at.MEAN_X_LOW])
    y = np.float64(geom[row + at.MEAN_Y]) - tile_y + np.float64(geom[row + at.MEAN_Y_LOW])
    shear = np.float64(geom[row + at.SHEAR]) + np.float64(geom[row + at.SHEAR_LOW])
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
    u_gap = select(u_gap > _ZERO, u_gap, _ZERO)
    e_gap = select(e_gap > _ZERO, e_gap, _ZERO)
    reach = geom[row + at.LOG2_OPACITY] - LOG2_MIN_ALPHA + _SLACK
    return bits(fma(u_gap, u_gap, e_gap * e_gap) <= reach), slope


@inline
def enter_batch(
    geom, base, entries, start, stop, last, tile_x, tile_y, alive, offsets, blocks, ids, slopes
):
    """`enter_tile` for the entries from `start` to `stop`, ahead of blending them.

    Were each splat blended right away, the processor would guess wrongly how many blocks it has
    and wait for this arithmetic every time.
    """
    for k in range(start, stop):
        if k + BATCH < last:
            prefetch(geom, (base + np.int64(entries[k + BATCH] & GAUSSIAN)) * at.ROW)
        i = k - start
        g = np.int64(entries[k] & GAUSSIAN)
        inside, slope = enter_tile(
            geom, (base + g) * at.ROW, tile_x, tile_y, offsets, 2 * BLOCKS * i
        )
        blocks[i] = inside & alive
        ids[i] = g
        slopes[i] = slope


@inline
def relative_pixels(geom, row, slope):
    """u and e of the pixels of a block, relative to its first."""
    u = fma(pixel_row(), slope, pixel_column() * geom[row + at.ALONG])
    return u, pixel_row() * geom[row + at.ACROSS]


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
        if bits(load_pixels(state, b * stride) > _ZERO) != 0:
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
