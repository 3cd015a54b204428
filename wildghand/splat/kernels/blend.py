"""Forward pass: every tile blends its splats from front to back."""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from wildghand.splat.kernels import geometry as at
from wildghand.splat.kernels.alpha import (
    BATCH,
    alive_blocks,
    clamped_alpha,
    enter_batch,
    log2_alpha,
    place_of,
    relative_pixels,
    scratch,
)
from wildghand.splat.kernels.channels import count, fetch, paint
from wildghand.splat.kernels.jit import inline, kernel
from wildghand.splat.kernels.jobs import next_job
from wildghand.splat.kernels.lanes import (
    absolute,
    bits,
    count_bits,
    lowest_bit,
    negate,
    select,
    store,
)
from wildghand.splat.kernels.tiles import (
    BLOCKS,
    LANES,
    LOG2_MIN_ALPHA,
    MIN_TRANSMITTANCE,
    TILE_HEIGHT,
    TILE_WIDTH,
    fill_pixels,
    load_pixels,
)

_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)


@inline
def blend_tile(
    geom, base, colors, color_base, entries, first, last, tile_x, tile_y,
    state, offsets, blocks, ids, slopes, channels, counting,
):  # fmt: skip
    """Blends the entries from `first` to `last` into the tile's state.

    Returns:
        Where the list could stop, because every pixel was saturated; the blended pairs.
    """
    stride = (1 + count(channels)) * LANES
    pairs = 0
    for start in range(first, last, BATCH):
        alive = alive_blocks(state, stride)
        if alive == 0:
            return start, pairs
        stop = min(start + BATCH, last)
        enter_batch(
            geom, base, entries, start, stop, last, tile_x, tile_y, alive,
            offsets, blocks, ids, slopes,
        )  # fmt: skip
        for i in range(stop - start):
            row = (base + ids[i]) * at.ROW
            u_pixel, e_pixel = relative_pixels(geom, row, slopes[i])
            opacity = geom[row + at.LOG2_OPACITY]
            color = fetch(colors, (color_base + ids[i]) * count(channels), channels)
            inside = blocks[i]
            while inside != 0:
                b = lowest_bit(inside)
                inside &= inside - np.uint64(1)
                u = u_pixel + offsets[2 * BLOCKS * i + b]
                e = e_pixel + offsets[2 * BLOCKS * i + BLOCKS + b]
                power = log2_alpha(u, e, opacity)
                seen = power >= LOG2_MIN_ALPHA
                place = b * stride
                before = load_pixels(state, place)
                weight = clamped_alpha(power) * before
                after = before - weight
                lives = after > MIN_TRANSMITTANCE
                weight = select(seen & lives, weight, _ZERO)
                paint(state, place + LANES, weight, colors, color, channels)
                stopped = negate(absolute(before))
                store(state, place, select(seen, select(lives, after, stopped), before))
                if counting:
                    pairs += count_bits(bits(seen & lives))
    return last, pairs


@kernel
def blend(
    worker, counters, ends,
    start, entries, geom, colors, color_repeat, backgrounds, width, height, gaussians,
    images, alphas, remaining, stops, pairs, channels, counting,
):  # fmt: skip
    """Draws every image.

    Args:
        worker, counters, ends: see `next_job`; a job is a tile.
        start, entries: the lists of all tiles of all images, see `bins`.
        geom: flat float32 (I, N, 16).
        colors: flat float32 (S, N, D).
        color_repeat: image i reads entry i // color_repeat of the S.
        backgrounds: float32 (I, D).
        width, height, gaussians: pixels and N.
        images: out, flat float32 (I, H, W, D).
        alphas: out, flat float32 (I, H, W).
        remaining: out, flat float32 (I, H, W); transmittance.
        stops: out, int64 (tiles,); end of the part of each list that was looked at.
        pairs: out, int64 (tiles,); blended (splat, pixel) pairs, if `counting`.
        channels: D, or a tuple of D zeros (see `channels`).
        counting: whether to count pairs.
    """
    size = count(channels)
    stride = (1 + size) * LANES
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    tiles_y = (height + TILE_HEIGHT - 1) // TILE_HEIGHT
    state = scratch(BLOCKS * stride)
    offsets = scratch(2 * BLOCKS * BATCH)
    blocks = np.empty(BATCH, np.uint64)
    ids = np.empty(BATCH, np.int64)
    slopes = np.empty(BATCH, np.float32)
    while True:
        tile = next_job(worker, counters, ends)
        if tile < 0:
            break
        image = tile // (tiles_x * tiles_y)
        left = tile % tiles_x * TILE_WIDTH
        top = tile // tiles_x % tiles_y * TILE_HEIGHT
        first, last = start[tile], start[tile + 1]
        stops[tile] = first
        pairs[tile] = 0
        if first < last:
            for b in range(BLOCKS):
                for k in range(size):
                    store(state, b * stride + (1 + k) * LANES, fill_pixels(_ZERO))
                store(state, b * stride, fill_pixels(_ONE))
            for y in range(TILE_HEIGHT):
                for x in range(TILE_WIDTH):
                    if left + x >= width or top + y >= height:
                        b, lane = place_of(x, y)
                        state[b * stride + lane] = -_ONE
            stops[tile], pairs[tile] = blend_tile(
                geom, image * gaussians, colors, image // color_repeat * gaussians, entries,
                first, last, left + 0.5, top + 0.5,
                state, offsets, blocks, ids, slopes, channels, counting,
            )  # fmt: skip
        for y in range(min(TILE_HEIGHT, height - top)):
            line = (image * height + top + y) * width + left
            for x in range(min(TILE_WIDTH, width - left)):
                to = line + x
                if first < last:
                    b, lane = place_of(x, y)
                    at_pixel = b * stride + lane
                    rest = abs(state[at_pixel])
                    for k in range(size):
                        color = state[at_pixel + (1 + k) * LANES]
                        images[to * size + k] = color + rest * backgrounds[image, k]
                else:
                    rest = _ONE
                    for k in range(size):
                        images[to * size + k] = backgrounds[image, k]
                remaining[to] = rest
                alphas[to] = _ONE - rest
