"""The visible Gaussians of each image from front to back, and of each tile.

First a radix sort on float32 depth, then a stable counting sort: the visible Gaussians of an image
are cut into chunks. Each chunk finds the tiles that its splats touch and counts them; a prefix sum
over (tile, chunk) says where each chunk writes; each chunk then writes. Any number of chunks gives
the same lists.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from wildghand.splat.kernels import tiles as at
from wildghand.splat.kernels.jit import inline, jobs, kernel
from wildghand.splat.kernels.tiles import LOG2_MIN_ALPHA, TILE_HEIGHT, TILE_WIDTH
from wildghand.splat.kernels.vectors import prefetch

#: Three digits cover the 32 bits of a depth; positive floats sort like their bits.
_BITS = 11
_DIGITS = 1 << _BITS
_MASK = np.uint32(_DIGITS - 1)


@kernel
def sort_by_depth(worker, counters, ends, depths, rows, order, spare, visible, chunk_rows):
    """Sorts every image; equal depths keep the order of their indices.

    Args:
        depths: float32 (I, N); 0 where culled.
        rows: int32 (I, N); tile rows of each Gaussian.
        order: out, int32 (I, N); indices of the visible ones, front to back.
        spare: scratch, int32 (I, N).
        visible: out, int64 (I,); how many there are.
        chunk_rows: out, int64 (I, K + 1); tile rows before each of K equal chunks of the order.
    """
    gaussians = depths.shape[1]
    digits = np.empty((3, _DIGITS), np.int32)
    for i in jobs(worker, counters, ends):
        first, second = order[i], spare[i]
        bits = depths[i].view(np.uint32)
        digits[:] = 0
        m = 0
        for n in range(gaussians):
            value = bits[n]
            if value != 0:
                second[m] = n
                m += 1
                for d in range(3):
                    digits[d, (value >> np.uint32(d * _BITS)) & _MASK] += 1
        for d in range(3):
            before = 0
            for k in range(_DIGITS):
                number = digits[d, k]
                digits[d, k] = before
                before += number
            # Each pass moves the places into the other array; the last one ends in `order`.
            source, target = (first, second) if d == 1 else (second, first)
            for k in range(m):
                n = source[k]
                digit = (bits[n] >> np.uint32(d * _BITS)) & _MASK
                target[digits[d, digit]] = n
                digits[d, digit] += 1
        visible[i] = m
        chunks = chunk_rows.shape[1] - 1
        total = 0
        for c in range(chunks):
            chunk_rows[i, c] = total
            for k in range(c * m // chunks, (c + 1) * m // chunks):
                total += rows[i, first[k]]
        chunk_rows[i, chunks] = total


_LOG2_MIN_ALPHA = float(LOG2_MIN_ALPHA)
#: Pixels by which the bounds are widened against rounding: costs nothing, since every
#: pixel is tested against the splat itself.
_SLACK = 2e-3
_AHEAD = 12
_BATCH = 32
_OVER_WIDTH = 1.0 / TILE_WIDTH  # a power of two, so exact
_MOST_ENTRIES = 2**31 - 1
_EMPTY = 1 << 16  # from tile 1 to tile 0


@inline
def find_spans(geom, row, last_column, first, number, spans, span):
    """First and last tile of a splat in each of its `number` tile rows, as two 16-bit halves.

    The ellipse is cut by the band of each tile row: its extreme points are where it is
    tangent to a vertical line, if that is in the band, else on the band's border.
    """
    x = np.float64(geom[row + at.MEAN_X]) + np.float64(geom[row + at.MEAN_X_LOW]) - 0.5
    y = np.float64(geom[row + at.MEAN_Y]) + np.float64(geom[row + at.MEAN_Y_LOW]) - 0.5
    shear = np.float64(geom[row + at.SHEAR]) + np.float64(geom[row + at.SHEAR_LOW])
    across = np.float64(geom[row + at.ACROSS])
    over_along = 1.0 / np.float64(geom[row + at.ALONG])
    reach_y = np.float64(geom[row + at.REACH_Y])
    tangent = np.float64(geom[row + at.TANGENT_Y])
    power = np.float64(geom[row + at.LOG2_OPACITY]) - _LOG2_MIN_ALPHA
    for r in range(number):
        low = (first + r) * TILE_HEIGHT - y - _SLACK
        high = low + (TILE_HEIGHT - 1 + 2 * _SLACK)
        low = max(low, -reach_y)
        high = min(high, reach_y)
        right_y = min(max(tangent, low), high)
        left_y = min(max(-tangent, low), high)
        right_e, left_e = across * right_y, across * left_y
        right = math.sqrt(max(power - right_e * right_e, 0.0)) * over_along - shear * right_y
        left = math.sqrt(max(power - left_e * left_e, 0.0)) * over_along + shear * left_y
        right, left = x + right + _SLACK, x - left - _SLACK
        left = max(np.ceil(left), 0.0)
        right = min(np.floor(right), last_column)
        if low <= high and left <= right:
            packed = (np.int64(left * _OVER_WIDTH) << 16) | np.int64(right * _OVER_WIDTH)
        else:
            packed = _EMPTY
        spans[span + r] = packed


class Walk(NamedTuple):
    """The visible Gaussians in order, in K chunks, with the tiles that each touches."""

    order: np.ndarray  # int32 (I, N)
    visible: np.ndarray  # int64 (I,)
    chunk_rows: np.ndarray  # int64 (I, K + 1), see `sort_by_depth`
    image_spans: np.ndarray  # int64 (I + 1,), where each image's spans start
    heads: np.ndarray  # uint32 (I, N); first tile row << 16 | tile rows, in the sorted order
    spans: np.ndarray  # uint32, see `find_spans`
    tiles_x: int  # tiles side by side


@kernel
def count_tiles(worker, counters, ends, geom, walk, width, counts, entry_count):
    """Finds the tiles of every visible Gaussian and counts, chunk by chunk.

    Args:
        geom: flat float32 (I, N, 16).
        walk: in order, out heads and spans.
        counts: out, int32 (I, K, tiles of an image).
        entry_count: in zeros, out, int32 (I, N); tiles that each Gaussian touches.
    """
    order, visible, chunk_rows, image_spans, heads, spans, tiles_x = walk
    gaussians = order.shape[1]
    chunks = counts.shape[1]
    for job in jobs(worker, counters, ends):
        i, c = job // chunks, job % chunks
        number = counts[i, c]
        number[:] = 0
        span = image_spans[i] + chunk_rows[i, c]
        stop = (c + 1) * visible[i] // chunks
        # In batches: a loop whose length depends on a square root just taken would stall.
        for start in range(c * visible[i] // chunks, stop, _BATCH):
            end = min(start + _BATCH, stop)
            filled = span
            for k in range(start, end):
                if k + _AHEAD < stop:
                    prefetch(geom, (i * gaussians + order[i, k + _AHEAD]) * at.ROW)
                row = (i * gaussians + order[i, k]) * at.ROW
                first = np.int64(geom[row + at.FIRST_ROW])
                rows = np.int64(geom[row + at.ROWS])
                heads[i, k] = (first << 16) | rows
                find_spans(geom, row, width - 1.0, first, rows, spans, filled)
                filled += rows
            for k in range(start, end):
                head = np.int64(heads[i, k])
                tile = (head >> 16) * tiles_x
                touched = 0
                for _ in range(head & 0xFFFF):
                    packed = np.int64(spans[span])
                    left, right = packed >> 16, packed & 0xFFFF
                    for x in range(left, right + 1):
                        number[tile + x] += 1
                    touched += right - left + 1
                    tile += tiles_x
                    span += 1
                entry_count[i, order[i, k]] = touched


@kernel
def place_tiles(counts, entry_count, start, first_entry):
    """Turns counts into places: where each chunk writes in the list of each tile.

    Args:
        counts: in int32 (I, K, tiles); out, the first place.
        entry_count: int32 (I, N).
        start: out, int64 (I * tiles + 1,); where each tile's list starts.
        first_entry: out, int32 (I * N + 1,); entries of the Gaussians before.
    """
    images, chunks, tiles = counts.shape
    place = 0
    for i in range(images):
        for t in range(tiles):
            start[i * tiles + t] = place
            for c in range(chunks):
                number = counts[i, c, t]
                counts[i, c, t] = place
                place += number
        if place > _MOST_ENTRIES:
            return -1
    start[images * tiles] = place
    before = 0
    flat = entry_count.reshape(-1)
    for n in range(flat.size):
        first_entry[n] = before
        before += flat[n]
    first_entry[flat.size] = before
    return place


@kernel
def fill_tiles(worker, counters, ends, walk, places, first_entry, entries):
    """Writes the lists.

    Args:
        entries: out, uint64 (E,); tile by tile, front to back: the Gaussian in the low half, in
            the high half the number of the entry in order of Gaussians.
    """
    order, visible, chunk_rows, image_spans, heads, spans, tiles_x = walk
    gaussians = order.shape[1]
    chunks = places.shape[1]
    for job in jobs(worker, counters, ends):
        i, c = job // chunks, job % chunks
        place = places[i, c]
        span = image_spans[i] + chunk_rows[i, c]
        for k in range(c * visible[i] // chunks, (c + 1) * visible[i] // chunks):
            g = np.int64(order[i, k])
            head = np.int64(heads[i, k])
            tile = (head >> 16) * tiles_x
            entry = np.int64(first_entry[i * gaussians + g])
            for _ in range(head & 0xFFFF):
                packed = np.int64(spans[span])
                for x in range(packed >> 16, (packed & 0xFFFF) + 1):
                    to = place[tile + x]
                    place[tile + x] = to + 1
                    entries[to] = (entry << 32) | g
                    entry += 1
                tile += tiles_x
                span += 1
