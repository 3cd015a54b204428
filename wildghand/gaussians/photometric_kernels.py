"""Compiled passes of the photometric loss, row by row and 16 numbers at a time.

A row of an image is W x C numbers, channel after channel. Sums over the rows of the SSIM window
are made first, straight from the images, and then the sums along the row, at distances of C. Far
from everything that is not black, nothing is computed: there both images are equal.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types

from hwp_bench.base.kernels import compiled
from wildghand.splat.kernels.jit import inline
from wildghand.splat.kernels.jobs import next_job
from wildghand.splat.kernels.lanes import absolute, bits, fma, make_fill, make_load, select, store
from wildghand.splat.kernels.simd import Vector

#: Numbers that are worked on together; a row must have as many.
LANES = 16
#: Edge of the window, px, as in `wildghand.gaussians.losses`.
WINDOW = 11

_HALF = WINDOW // 2
_ALL = 2**LANES - 1
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)
_FLOATS = Vector(types.float32, LANES)
_load = make_load(_FLOATS)
_fill = make_fill(_FLOATS)


class Images(NamedTuple):
    """B pairs of images of H rows."""

    x: np.ndarray  # (B, H, W * C) float32, what is compared
    y: np.ndarray  # (B, H, W * C) float32, what it is compared with
    weights: np.ndarray  # (B, H, W) float32
    content: np.ndarray  # (B, 4) int64, see `find_content`


class Constants(NamedTuple):
    """Constants of the loss."""

    window: np.ndarray  # (11,) float32, symmetric
    dssim_weight: np.float32  # lambda
    c1: np.float32  # stabilisers of SSIM
    c2: np.float32
    values: np.float32  # numbers in the batch


class Made(NamedTuple):
    """Results of the first pass."""

    errors: np.ndarray  # (B, H, W) float32, summed over channels
    sums: np.ndarray  # (B, H) float64, weighted errors of each row
    direct: np.ndarray  # (B, H, W * C) float32, gradient of the L1 term
    factors: np.ndarray  # (3, B, H, W * C) float32; blurred, they make the gradient of SSIM


@compiled(nogil=True)
def find_content(worker, counters, ends, x, y, channels, content):
    """The part of each image outside of which both images are zero.

    Args:
        worker, counters, ends: see `wildghand.splat.kernels.jobs.next_job`; a job is an image.
        x, y: (B, H, W * C) float32.
        channels: C.
        content: int64 (B, 4), filled: first and last row, first and last number of a row, the last
            ones excluded; zeros where all is zero.
    """
    height, size = x.shape[1:]
    seen = np.empty(size, np.bool_)
    while True:
        image = next_job(worker, counters, ends)
        if image < 0:
            break
        seen[:] = False
        top, bottom = height, 0
        for row in range(height):
            at = (image * height + row) * size
            some = False
            for place in range(0, size, LANES):
                j = min(place, size - LANES)
                largest = absolute(_load(x, at + j)) + absolute(_load(y, at + j))
                # A comparison with NaN is false.
                if bits(largest <= _ZERO) != _ALL:
                    some = seen[j] = True
            if some:
                top, bottom = min(top, row), row + 1
        content[image] = 0
        if bottom > 0:
            first, last = 0, size - LANES
            while not seen[first]:
                first += 1
            while not seen[last]:
                last -= 1
            content[image, 0], content[image, 1] = top, bottom
            content[image, 2] = first // channels * channels
            content[image, 3] = (last + LANES + channels - 1) // channels * channels


@inline
def _grown(content, image, height, size, channels, margin):
    """The content's rows and numbers of a row with a margin, px."""
    return (
        max(0, content[image, 0] - margin),
        min(height, content[image, 1] + margin) * (content[image, 1] > 0),
        max(0, content[image, 2] - margin * channels),
        min(size, content[image, 3] + margin * channels),
    )


@inline
def _sum_moments(images, image, row, first, last, window, blurred):
    """Sums over rows of the window: x, y, x^2, y^2 and x y from 5 px on in a row of `blurred`."""
    height, size = images.x.shape[1:]
    stride = blurred.shape[1]
    pad = (stride - size) // 2
    for place in range(first, last, LANES):
        j = min(place, last - LANES)
        x, y, xx, yy, xy = _fill(_ZERO), _fill(_ZERO), _fill(_ZERO), _fill(_ZERO), _fill(_ZERO)
        for k in range(max(0, row - _HALF), min(height, row + _HALF + 1)):
            at = (image * height + k) * size + j
            u, v, weight = _load(images.x, at), _load(images.y, at), window[k - row + _HALF]
            wu, wv = u * weight, v * weight
            x, y, xx, yy, xy = x + wu, y + wv, fma(wu, u, xx), fma(wv, v, yy), fma(wu, v, xy)
        store(blurred, pad + j, x)
        store(blurred, stride + pad + j, y)
        store(blurred, 2 * stride + pad + j, xx)
        store(blurred, 3 * stride + pad + j, yy)
        store(blurred, 4 * stride + pad + j, xy)
    _clear_ends(blurred, pad, first, last)


@inline
def _clear_ends(blurred, pad, first, last):
    """Zeros where windows reach beyond what was summed."""
    for m in range(blurred.shape[0]):
        for k in range(pad):
            blurred[m, first + k] = blurred[m, pad + last + k] = _ZERO


@inline
def _compare_row(images, at, first, last, channels, constants, blurred, spread, errors, made):
    """SSIM and L1 of a row that begins `at`, and what their gradient is made of."""
    window, dssim_weight, c1, c2, _ = constants
    stride = blurred.shape[1]
    plane = made.direct.size
    share = _ONE - dssim_weight
    for place in range(first, last, LANES):
        j = min(place, last - LANES)
        x, y, xx, yy, xy = _fill(_ZERO), _fill(_ZERO), _fill(_ZERO), _fill(_ZERO), _fill(_ZERO)
        for k in range(WINDOW):
            i, weight = j + k * channels, window[k]
            x = fma(_load(blurred, i), weight, x)
            y = fma(_load(blurred, stride + i), weight, y)
            xx = fma(_load(blurred, 2 * stride + i), weight, xx)
            yy = fma(_load(blurred, 3 * stride + i), weight, yy)
            xy = fma(_load(blurred, 4 * stride + i), weight, xy)
        product, squares = x * y, x * x + y * y
        a1 = product * _TWO + c1
        a2 = (xy - product) * _TWO + c2
        b1 = squares + c1
        spreads = xx + yy - squares
        # Rounding may push a variance below 0; the sum must stay away from it. NaN stays NaN.
        b2 = select(spreads < _ZERO, _fill(_ZERO), spreads) + c2
        inverse = _fill(_ONE) / (b1 * b2)
        ssim = a1 * a2 * inverse
        difference = _load(images.x, at + j) - _load(images.y, at + j)
        loss = absolute(difference) * share + (_fill(_ONE) - ssim) * dssim_weight
        store(errors, j, loss)
        weight_of = _load(spread, j)
        sign = select(difference > _ZERO, _fill(_ONE), _fill(_ZERO))
        sign = select(difference < _ZERO, _fill(-_ONE), sign)
        store(made.direct, at + j, weight_of * share * sign)
        scale = weight_of * dssim_weight
        share1, share2 = b2 * inverse, b1 * inverse
        of_mean = (x * ssim * (share1 - share2) - y * (a2 - a1) * inverse) * _TWO
        store(made.factors, at + j, scale * of_mean)
        store(made.factors, plane + at + j, scale * ssim * share2)
        store(made.factors, 2 * plane + at + j, scale * (a1 * inverse) * (-_TWO))


@compiled(nogil=True)
def compare(worker, counters, ends, images, channels, constants, made):
    """Errors of every row, and what their gradient is made of.

    Args:
        worker, counters, ends: see `find_content`; a job is a row of an image.
        images: what is compared.
        channels: C.
        constants: of the loss.
        made: filled; `factors` within 5 px of the content only.
    """
    height, size = images.x.shape[1:]
    width = size // channels
    lambda_, c1, c2 = constants.dssim_weight, constants.c1, constants.c2
    blurred = np.empty((5, size + 2 * _HALF * channels), np.float32)
    spread, errors = np.empty(size, np.float32), np.empty(size, np.float32)
    # What rounding leaves of a pixel that is black in both.
    black = (_ONE - c1 * c2 * (_ONE / (c1 * c2))) * lambda_ * np.float32(channels)
    while True:
        job = next_job(worker, counters, ends)
        if job < 0:
            break
        image, row = job // height, job % height
        weights, line = images.weights[image, row], made.errors[image, row]
        top, bottom, first, last = _grown(images.content, image, height, size, channels, _HALF)
        line[:] = black
        made.direct[image, row] = _ZERO
        if top <= row < bottom:
            for pixel in range(first // channels, last // channels):
                for c in range(channels):
                    spread[pixel * channels + c] = weights[pixel] / constants.values
            _sum_moments(images, image, row, first, last, constants.window, blurred)
            at = job * size
            _compare_row(
                images, at, first, last, channels, constants, blurred, spread, errors, made
            )
            for pixel in range(first // channels, last // channels):
                total = _ZERO
                for c in range(channels):
                    total += errors[pixel * channels + c]
                line[pixel] = total
        found = 0.0
        for pixel in range(width):
            found += np.float64(line[pixel]) * np.float64(weights[pixel])
        made.sums[image, row] = found


@compiled(nogil=True)
def gather(worker, counters, ends, images, channels, window, made, gradient):
    """The gradient by x. The window is symmetric and the border zero: it is its own adjoint.

    Args:
        worker, counters, ends: see `find_content`; a job is a row of an image.
        images, channels: as compared.
        window: (11,) float32.
        made: from `compare`.
        gradient: (B, H, W * C) float32, filled.
    """
    height, size = images.x.shape[1:]
    # Windows of pixels that are 10 px away from the content still reach the factors.
    pad = 2 * _HALF * channels
    blurred = np.empty((3, size + 2 * pad), np.float32)
    stride, plane = blurred.shape[1], made.direct.size
    while True:
        job = next_job(worker, counters, ends)
        if job < 0:
            break
        image, row = job // height, job % height
        gradient[image, row] = _ZERO
        top, bottom, first, last = _grown(images.content, image, height, size, channels, _HALF)
        start, stop = max(top, row - _HALF), min(bottom, row + _HALF + 1)
        if start >= stop:
            continue
        for place in range(first, last, LANES):
            j = min(place, last - LANES)
            f0, f1, f2 = _fill(_ZERO), _fill(_ZERO), _fill(_ZERO)
            for k in range(start, stop):
                at, weight = (image * height + k) * size + j, window[k - row + _HALF]
                f0 = fma(_load(made.factors, at), weight, f0)
                f1 = fma(_load(made.factors, plane + at), weight, f1)
                f2 = fma(_load(made.factors, 2 * plane + at), weight, f2)
            store(blurred, pad + j, f0)
            store(blurred, stride + pad + j, f1)
            store(blurred, 2 * stride + pad + j, f2)
        _clear_ends(blurred, pad, first, last)
        first, last = max(0, first - pad // 2), min(size, last + pad // 2)
        for place in range(first, last, LANES):
            j = min(place, last - LANES)
            f0, f1, f2 = _fill(_ZERO), _fill(_ZERO), _fill(_ZERO)
            for k in range(WINDOW):
                i, weight = pad // 2 + j + k * channels, window[k]
                f0 = fma(_load(blurred, i), weight, f0)
                f1 = fma(_load(blurred, stride + i), weight, f1)
                f2 = fma(_load(blurred, 2 * stride + i), weight, f2)
            at = job * size + j
            x, y = _load(images.x, at), _load(images.y, at)
            store(gradient, at, _load(made.direct, at) + f0 + x * f1 * _TWO + y * f2)
