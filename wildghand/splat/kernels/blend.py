"""Every tile blends its splats from front to back; the backward pass does so once more.

The gradients of each (splat, tile) have a slot of their own, so threads share nothing, and each
Gaussian adds its slots in the order of its tiles: the sums are the same bits on every run.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from wildghand.splat.kernels import tiles as at
from wildghand.splat.kernels.jit import inline, jobs, kernel
from wildghand.splat.kernels.project import (
    GROUP,
    PIECE,
    clear_first,
    entry_of,
    fill_exact,
    load1,
)
from wildghand.splat.kernels.tiles import (
    BATCH,
    BLOCKS,
    LANES,
    LOG2_MAX_ALPHA,
    LOG2_MIN_ALPHA,
    MIN_TRANSMITTANCE,
    MOMENTS,
    ONE,
    TILE_HEIGHT,
    TILE_WIDTH,
    ZERO,
    add_to_sums,
    alive_blocks,
    clamped_alpha,
    count,
    enter_batch,
    fetch,
    fill_pixels,
    finish_sums,
    load_pixels,
    log2_alpha,
    paint,
    place_of,
    project,
    relative_pixels,
    scratch,
    start_sums,
)
from wildghand.splat.kernels.vectors import (
    absolute,
    bits,
    count_bits,
    fma,
    lowest_bit,
    negate,
    prefetch,
    select,
    store,
)


class TileScene(NamedTuple):
    """Input of both passes: splats, and which of them each tile blends."""

    start: np.ndarray  # (tiles + 1,) int64, where the list of each tile starts
    entries: np.ndarray  # (E,) uint64, see `lists.fill_tiles`
    geom: np.ndarray  # flat float32 (I, N, 16)
    colors: np.ndarray  # flat float32 (S, N, D)
    color_repeat: int  # images in a row that read the same colours
    width: int
    height: int
    gaussians: int


class Workspace(NamedTuple):
    """Memory of one thread."""

    state: np.ndarray  # vectors of each block of a tile, transmittance first
    offsets: np.ndarray  # of the entries at hand, what `enter_batch` writes
    blocks: np.ndarray
    ids: np.ndarray
    slopes: np.ndarray


@inline
def make_workspace(stride):
    """Room for blocks of `stride` floats."""
    return Workspace(
        scratch(BLOCKS * stride), scratch(2 * BLOCKS * BATCH), np.empty(BATCH, np.uint64),
        np.empty(BATCH, np.int64), np.empty(BATCH, np.float32),
    )  # fmt: skip


@inline
def meet(u_pixel, e_pixel, offsets, to, b, opacity, state, place):
    """One splat over the pixels of block `b`, whose transmittance lies at `place`.

    Takes from the transmittance what the splat leaves, which both passes must decide alike.
    """
    u = u_pixel + offsets[to + b]
    e = e_pixel + offsets[to + BLOCKS + b]
    power = log2_alpha(u, e, opacity)
    seen = power >= LOG2_MIN_ALPHA
    before = load_pixels(state, place)
    alpha = clamped_alpha(power)
    weight = alpha * before
    after = before - weight
    lives = after > MIN_TRANSMITTANCE
    blended = seen & lives
    stopped = negate(absolute(before))
    store(state, place, select(seen, select(lives, after, stopped), before))
    return u, e, power, before, alpha, select(blended, weight, ZERO), blended


@inline
def corner_of(tile, width, height):
    """Image, left and top pixel of a tile."""
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    tiles_y = (height + TILE_HEIGHT - 1) // TILE_HEIGHT
    left, top = tile % tiles_x * TILE_WIDTH, tile // tiles_x % tiles_y * TILE_HEIGHT
    return tile // (tiles_x * tiles_y), left, top


@inline
def blend_tile(scene, corner, first, last, work, channels, counting):
    """Blends the entries from `first` to `last` into the tile's state.

    Returns:
        Where the list could stop, because every pixel was saturated; the blended pairs.
    """
    image, left, top = corner
    geom, colors, state = scene.geom, scene.colors, work.state
    base = image * scene.gaussians
    color_base = image // scene.color_repeat * scene.gaussians
    stride = (1 + count(channels)) * LANES
    pairs = 0
    for start in range(first, last, BATCH):
        alive = alive_blocks(state, stride)
        if alive == 0:
            return start, pairs
        stop = min(start + BATCH, last)
        enter_batch(geom, base, scene.entries, start, stop, last, left, top, alive, work)
        for i in range(stop - start):
            n = work.ids[i]
            row = (base + n) * at.ROW
            u_pixel, e_pixel = relative_pixels(geom, row, work.slopes[i])
            opacity = geom[row + at.LOG2_OPACITY]
            color = fetch(colors, (color_base + n) * count(channels), channels)
            inside = work.blocks[i]
            while inside != 0:
                b = lowest_bit(inside)
                inside &= inside - np.uint64(1)
                place = b * stride
                _, _, _, _, _, weight, blended = meet(
                    u_pixel, e_pixel, work.offsets, 2 * BLOCKS * i, b, opacity, state, place
                )
                paint(state, place + LANES, weight, colors, color, channels)
                if counting:
                    pairs += count_bits(bits(blended))
    return last, pairs


@kernel
def blend(
    worker, counters, ends,
    scene, backgrounds, images, alphas, remaining, stops, pairs, channels, counting,
):  # fmt: skip
    """Draws every image.

    Args:
        scene: `TileScene`.
        backgrounds: float32 (I, D).
        images: out, flat float32 (I, H, W, D).
        alphas: out, flat float32 (I, H, W).
        remaining: out, flat float32 (I, H, W); transmittance.
        stops: out, int64 (tiles,); end of the part of each list that was looked at.
        pairs: out, int64 (tiles,); blended (splat, pixel) pairs, if `counting`.
    """
    width, height = scene.width, scene.height
    size = count(channels)
    stride = (1 + size) * LANES
    work = make_workspace(stride)
    state = work.state
    for tile in jobs(worker, counters, ends):
        corner = corner_of(tile, width, height)
        image, left, top = corner
        first, last = scene.start[tile], scene.start[tile + 1]
        stops[tile] = first
        pairs[tile] = 0
        if first < last:
            for b in range(BLOCKS):
                for k in range(size):
                    store(state, b * stride + (1 + k) * LANES, fill_pixels(ZERO))
                store(state, b * stride, fill_pixels(ONE))
            for y in range(TILE_HEIGHT):
                for x in range(TILE_WIDTH):
                    if left + x >= width or top + y >= height:
                        b, lane = place_of(x, y)
                        state[b * stride + lane] = -ONE
            stops[tile], pairs[tile] = blend_tile(
                scene, corner, first, last, work, channels, counting
            )
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
                    rest = ONE
                    for k in range(size):
                        images[to * size + k] = backgrounds[image, k]
                remaining[to] = rest
                alphas[to] = ONE - rest


@inline
def tile_backward(scene, corner, first, last, work, sum_scratch, slots, slot, slot_size, channels):
    """Gradients of the entries from `first` to `last`, written to consecutive slots.

    Front to back again, with one number for all that lies behind. For a pixel with upstream
    gradient v, a splat of colour c, alpha a and transmittance T before it:

        dL/dc = a T v,    dL/da = T (c . v) - R / (1 - a)

    where R, what the pixel gets from behind the splat times v, starts as the whole pixel's and
    loses a T (c . v) at every splat. So nothing but the image and its transmittance need be kept
    from the forward pass.
    """
    image, left, top = corner
    geom, colors, state = scene.geom, scene.colors, work.state
    base = image * scene.gaussians
    color_base = image // scene.color_repeat * scene.gaussians
    stride = (2 + count(channels)) * LANES
    zero = fill_pixels(ZERO)
    for start in range(first, last, BATCH):
        stop = min(start + BATCH, last)
        alive = alive_blocks(state, stride)
        enter_batch(geom, base, scene.entries, start, stop, last, left, top, alive, work)
        for i in range(stop - start):
            n = work.ids[i]
            row = (base + n) * at.ROW
            u_pixel, e_pixel = relative_pixels(geom, row, work.slopes[i])
            opacity = geom[row + at.LOG2_OPACITY]
            color = fetch(colors, (color_base + n) * count(channels), channels)
            sums = start_sums(sum_scratch, channels)
            m, m_u, m_e, m_uu, m_ue, m_ee = zero, zero, zero, zero, zero, zero
            inside = work.blocks[i]
            while inside != 0:
                b = lowest_bit(inside)
                inside &= inside - np.uint64(1)
                place = b * stride
                u, e, power, before, alpha, weight, blended = meet(
                    u_pixel, e_pixel, work.offsets, 2 * BLOCKS * i, b, opacity, state, place
                )
                gain = project(state, place + 2 * LANES, colors, color, channels)
                behind = fma(negate(weight), gain, load_pixels(state, place + LANES))
                store(state, place + LANES, behind)
                v_alpha = fma(before, gain, negate(behind / (ONE - alpha)))
                free = blended & (power <= LOG2_MAX_ALPHA)
                v_power = select(free, alpha * v_alpha, ZERO)
                sums = add_to_sums(sums, weight, state, place + 2 * LANES)
                v_u, v_e = v_power * u, v_power * e
                m, m_u, m_e = m + v_power, m_u + v_u, m_e + v_e
                m_uu, m_ue, m_ee = fma(v_u, u, m_uu), fma(v_u, e, m_ue), fma(v_e, e, m_ee)
            finish_sums(slots, slot * slot_size, (m, m_u, m_e, m_uu, m_ue, m_ee), sums)
            slot += 1


@kernel
def blend_backward(
    worker, counters, ends,
    scene, stops, first_slot, images, remaining, v_images, v_alphas, slots, slot_size, slot_of,
    channels,
):  # fmt: skip
    """Gradients of every (splat, tile) pair that was looked at.

    Args:
        first_slot: int64 (tiles,); slot of the first entry of each tile.
        slots: out, flat float32, `slot_size` for each pair; see `tiles.finish_sums`.
        slot_of: out, int32 (E,); slot of each entry in order of Gaussians, or -1.
    """
    width, height, start, entries = scene.width, scene.height, scene.start, scene.entries
    size = count(channels)
    stride = (2 + size) * LANES
    work, sum_scratch = make_workspace(stride), scratch(size * LANES)
    state = work.state
    for tile in jobs(worker, counters, ends):
        first, last = start[tile], stops[tile]
        for k in range(first, last):
            slot_of[np.int64(entries[k] >> np.uint64(32))] = first_slot[tile] + k - first
        for k in range(last, start[tile + 1]):
            slot_of[np.int64(entries[k] >> np.uint64(32))] = -1
        if first == last:
            continue
        corner = corner_of(tile, width, height)
        image, left, top = corner
        columns, lines = min(TILE_WIDTH, width - left), min(TILE_HEIGHT, height - top)
        if columns < TILE_WIDTH or lines < TILE_HEIGHT:
            for b in range(BLOCKS):
                store(state, b * stride, fill_pixels(-ONE))
                for k in range(1 + size):
                    store(state, b * stride + (1 + k) * LANES, fill_pixels(ZERO))
        for y in range(lines):
            line = (image * height + top + y) * width + left
            for x in range(columns):
                pixel = line + x
                b, lane = place_of(x, y)
                to = b * stride + lane
                whole = -v_alphas[pixel] * remaining[pixel] if v_alphas.size > 0 else ZERO
                for k in range(size):
                    v = v_images[pixel * size + k]
                    state[to + (2 + k) * LANES] = v
                    whole += v * images[pixel * size + k]
                state[to] = ONE
                state[to + LANES] = whole
        tile_backward(
            scene, corner, first, last, work, sum_scratch, slots, first_slot[tile], slot_size,
            channels,
        )  # fmt: skip


@kernel
def background_backward(worker, counters, ends, v_images, remaining, v_lines):
    """Gradient of the background, one sum for each line of pixels.

    Args:
        v_images: float32 (I, H, W, D).
        remaining: float32 (I, H, W).
        v_lines: out, float64 (I, H, D).
    """
    _, height, width, size = v_images.shape
    for job in jobs(worker, counters, ends):
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


#: Entries by which slots are asked for before they are read.
_AHEAD = 24
_TWO_LN2 = 2.0 * math.log(2.0)


class BlendGradients(NamedTuple):
    """Gradients of the loss by the blended splats.

    `shapes`: with the exponent -1/2 (a u^2 + c e^2), u = dx + s dy, e = dy, they are the gradient
    of log a, of log c, and of s times sqrt(c / a). They have no unit, so they fit into float32 for
    every size of splat.
    """

    means2d: np.ndarray  # (I, N, 2) float32, px^-1
    shapes: np.ndarray  # (I, N, 3) float32
    opacities: np.ndarray  # (S, N) float32
    colors: np.ndarray  # (S, N, D) float32


@kernel
def reduce_slots(
    worker, counters, ends, geom, depths, opacities, first_entry, slot_of, slots, gradients
):
    """Gradients of the projected Gaussians, summed over images where images share them.

    Args:
        opacities: float32 (S, N), as blended.
        first_entry: int32 (I * N + 1,); see `bins`.
        slot_of: int32 (E,); slot of each entry, -1 if nothing of it was blended.
        slots: float32, a row for each; see `channels.finish_sums`.
    """
    images, gaussians = depths.shape
    v_means2d, v_shapes, v_opacities, v_colors = gradients
    channels = v_colors.shape[2]
    pieces = max(1, gaussians // PIECE)
    groups = (MOMENTS + channels + GROUP - 1) // GROUP
    sums = np.empty(groups * GROUP, np.float64)
    for piece in jobs(worker, counters, ends):
        begin, stop = piece * gaussians // pieces, (piece + 1) * gaussians // pieces
        for i in range(images):
            clear_first(v_opacities, i, images, begin, stop)
            clear_first(v_colors, i, images, begin, stop)
            of_opacities = entry_of(v_opacities, i, images)
            of_colors = entry_of(v_colors, i, images)
            for n in range(begin, stop):
                if not depths[i, n] > 0:
                    v_means2d[i, n, 0] = v_means2d[i, n, 1] = 0.0
                    for k in range(3):
                        v_shapes[i, n, k] = 0.0
                    continue
                to = i * gaussians + n
                add_slots(first_entry[to], first_entry[to + 1], slot_of, slots, sums)
                along = np.float64(geom[i, n, at.ALONG])
                across = np.float64(geom[i, n, at.ACROSS])
                shear = np.float64(geom[i, n, at.SHEAR]) + np.float64(geom[i, n, at.SHEAR_LOW])
                m, m_u, m_e, m_uu, m_ue, m_ee = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
                v_x = _TWO_LN2 * along * m_u
                v_means2d[i, n, 0] = v_x
                v_means2d[i, n, 1] = _TWO_LN2 * across * m_e + shear * v_x
                v_shapes[i, n, 0] = -0.5 * _TWO_LN2 * m_uu
                v_shapes[i, n, 1] = -0.5 * _TWO_LN2 * m_ee
                v_shapes[i, n, 2] = -_TWO_LN2 * m_ue
                v_opacities[of_opacities, n] += m / opacities[of_opacities, n]
                for k in range(channels):
                    v_colors[of_colors, n, k] += sums[MOMENTS + k]


@inline
def add_slots(first, last, slot_of, slots, sums):
    """Writes the sum of the slots of entries `first` to `last` to `sums`, in their order."""
    slot_size = slots.shape[1]
    low, high = fill_exact(0.0), fill_exact(0.0)
    for entry in range(first, last):
        if entry + _AHEAD < slot_of.size:
            prefetch(slots, np.int64(slot_of[entry + _AHEAD]) * slot_size)
        slot = np.int64(slot_of[entry])
        if slot >= 0:
            (part,) = load1(slots, slot * slot_size)
            low = low + part
            if sums.size > GROUP:
                (part,) = load1(slots, slot * slot_size + GROUP)
                high = high + part
    store(sums, 0, low)
    if sums.size > GROUP:
        store(sums, GROUP, high)
    for k in range(2 * GROUP, sums.size, GROUP):  # more channels than usual
        low = fill_exact(0.0)
        for entry in range(first, last):
            slot = np.int64(slot_of[entry])
            if slot >= 0:
                (part,) = load1(slots, slot * slot_size + k)
                low = low + part
        store(sums, k, low)
