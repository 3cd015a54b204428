"""Backward pass over tiles, front to back again, with one number for all that lies behind.

For a pixel with upstream gradient v, a splat of colour c, alpha a and transmittance T before it:

    dL/dc = a T v,    dL/da = T (c . v) - R / (1 - a)

where R, what the pixel gets from behind the splat times v, starts as the whole pixel's and
loses a T (c . v) at every splat. So nothing but the image and its transmittance need be kept
from the forward pass.
"""

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
from wildghand.splat.kernels.channels import (
    add_to_sums,
    count,
    fetch,
    finish_sums,
    project,
    start_sums,
)
from wildghand.splat.kernels.jit import inline, kernel
from wildghand.splat.kernels.jobs import next_job
from wildghand.splat.kernels.lanes import (
    absolute,
    fma,
    lowest_bit,
    negate,
    select,
    store,
)
from wildghand.splat.kernels.tiles import (
    BLOCKS,
    LANES,
    LOG2_MAX_ALPHA,
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
def tile_backward(
    geom, base, colors, color_base, entries, first, last, tile_x, tile_y,
    state, offsets, blocks, ids, slopes, sum_scratch, slots, slot, slot_size, channels,
):  # fmt: skip
    """Gradients of the entries from `first` to `last`, written to consecutive slots."""
    stride = (2 + count(channels)) * LANES
    for start in range(first, last, BATCH):
        stop = min(start + BATCH, last)
        enter_batch(
            geom, base, entries, start, stop, last, tile_x, tile_y, alive_blocks(state, stride),
            offsets, blocks, ids, slopes,
        )  # fmt: skip
        for i in range(stop - start):
            row = (base + ids[i]) * at.ROW
            u_pixel, e_pixel = relative_pixels(geom, row, slopes[i])
            opacity = geom[row + at.LOG2_OPACITY]
            color = fetch(colors, (color_base + ids[i]) * count(channels), channels)
            sums = start_sums(sum_scratch, channels)
            m = fill_pixels(_ZERO)
            m_u = fill_pixels(_ZERO)
            m_e = fill_pixels(_ZERO)
            m_uu = fill_pixels(_ZERO)
            m_ue = fill_pixels(_ZERO)
            m_ee = fill_pixels(_ZERO)
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
                alpha = clamped_alpha(power)
                weight = alpha * before
                after = before - weight
                lives = after > MIN_TRANSMITTANCE
                blended = seen & lives
                weight = select(blended, weight, _ZERO)
                stopped = negate(absolute(before))
                store(state, place, select(seen, select(lives, after, stopped), before))
                gain = project(state, place + 2 * LANES, colors, color, channels)
                behind = fma(negate(weight), gain, load_pixels(state, place + LANES))
                store(state, place + LANES, behind)
                v_alpha = fma(before, gain, negate(behind / (_ONE - alpha)))
                free = blended & (power <= LOG2_MAX_ALPHA)
                v_power = select(free, alpha * v_alpha, _ZERO)
                sums = add_to_sums(sums, weight, state, place + 2 * LANES)
                v_u = v_power * u
                v_e = v_power * e
                m = m + v_power
                m_u = m_u + v_u
                m_e = m_e + v_e
                m_uu = fma(v_u, u, m_uu)
                m_ue = fma(v_u, e, m_ue)
                m_ee = fma(v_e, e, m_ee)
            finish_sums(slots, slot * slot_size, (m, m_u, m_e, m_uu, m_ue, m_ee), sums)
            slot += 1


@kernel
def blend_backward(
    worker, counters, ends,
    start, stops, first_slot, entries, geom, colors, color_repeat, width, height,
    gaussians, images, remaining, v_images, v_alphas, slots, slot_size, slot_of, channels,
):  # fmt: skip
    """Gradients of every (splat, tile) pair that was looked at.

    Args:
        worker, counters, ends: see `next_job`; a job is a tile.
        start, entries, geom, colors, color_repeat, width, height, gaussians: as for `blend`.
        images, remaining, stops: as `blend` left them.
        first_slot: int64 (tiles,); slot of the first entry of each tile.
        v_images, v_alphas: flat, upstream gradients of images and alphas; the latter may be empty.
        slots: out, flat float32, `slot_size` for each pair; see `channels.finish_sums`.
        slot_of: out, int32 (E,); slot of each entry in order of Gaussians, or -1.
        channels: as for `blend`.
    """
    size = count(channels)
    stride = (2 + size) * LANES
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    tiles_y = (height + TILE_HEIGHT - 1) // TILE_HEIGHT
    state = scratch(BLOCKS * stride)
    offsets = scratch(2 * BLOCKS * BATCH)
    sum_scratch = scratch(size * LANES)
    blocks = np.empty(BATCH, np.uint64)
    ids = np.empty(BATCH, np.int64)
    slopes = np.empty(BATCH, np.float32)
    while True:
        tile = next_job(worker, counters, ends)
        if tile < 0:
            break
        first, last = start[tile], stops[tile]
        for k in range(first, last):
            slot_of[np.int64(entries[k] >> np.uint64(32))] = first_slot[tile] + k - first
        for k in range(last, start[tile + 1]):
            slot_of[np.int64(entries[k] >> np.uint64(32))] = -1
        if first == last:
            continue
        image = tile // (tiles_x * tiles_y)
        left = tile % tiles_x * TILE_WIDTH
        top = tile // tiles_x % tiles_y * TILE_HEIGHT
        columns, lines = min(TILE_WIDTH, width - left), min(TILE_HEIGHT, height - top)
        if columns < TILE_WIDTH or lines < TILE_HEIGHT:
            for b in range(BLOCKS):
                store(state, b * stride, fill_pixels(-_ONE))
                for k in range(1 + size):
                    store(state, b * stride + (1 + k) * LANES, fill_pixels(_ZERO))
        for y in range(lines):
            line = (image * height + top + y) * width + left
            for x in range(columns):
                pixel = line + x
                b, lane = place_of(x, y)
                to = b * stride + lane
                whole = -v_alphas[pixel] * remaining[pixel] if v_alphas.size > 0 else _ZERO
                for k in range(size):
                    v = v_images[pixel * size + k]
                    state[to + (2 + k) * LANES] = v
                    whole += v * images[pixel * size + k]
                state[to] = _ONE
                state[to + LANES] = whole
        tile_backward(
            geom, image * gaussians, colors, image // color_repeat * gaussians, entries,
            first, last, left + 0.5, top + 0.5,
            state, offsets, blocks, ids, slopes, sum_scratch, slots, first_slot[tile], slot_size,
            channels,
        )  # fmt: skip


@kernel
def background_backward(worker, counters, ends, v_images, remaining, v_lines):
    """Gradient of the background, one sum for each line of pixels.

    Args:
        worker, counters, ends: see `next_job`; a job is a line.
        v_images: float32 (I, H, W, D).
        remaining: float32 (I, H, W).
        v_lines: out, float64 (I, H, D).
    """
    _, height, width, size = v_images.shape
    while True:
        job = next_job(worker, counters, ends)
        if job < 0:
            break
        i, y = job // height, job % height
        sums = v_lines[i, y]
        sums[:] = 0.0
        if size == 3:  # in registers, since this is the usual number
            red = green = blue = 0.0
            for x in range(width):
                rest = np.float64(remaining[i, y, x])
                red += v_images[i, y, x, 0] * rest
                green += v_images[i, y, x, 1] * rest
                blue += v_images[i, y, x, 2] * rest
            sums[0], sums[1], sums[2] = red, green, blue
        else:
            for x in range(width):
                rest = np.float64(remaining[i, y, x])
                for k in range(size):
                    sums[k] += v_images[i, y, x, k] * rest
