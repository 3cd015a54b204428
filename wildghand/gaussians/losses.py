"""Losses on images: SSIM, and L1 + D-SSIM under pixel weights.

On the CPU, float32, loss and gradient are made in one go in a tenth of torch's time, row by row and
16 numbers at a time. A row of an image is W x C numbers, channel after channel. Sums over the rows
of the SSIM window are made first, straight from the images, and then the sums along the row, at
distances of C. Far from everything that is not black, nothing is computed: there both images are
equal.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import types

from hwp_bench.base.errors import ShapeMismatch
from wildghand.splat.kernels.jit import inline, jobs, kernel
from wildghand.splat.kernels.vectors import (
    Vector,
    absolute,
    add_lines,
    bits,
    fma,
    make_fill,
    make_load,
    select,
    store,
    store_lines,
)
from wildghand.splat.threads import kernels_take, run_jobs

#: Numbers that are worked on together; a row must have as many.
LANES = 16

#: Edge of the SSIM window, px.
WINDOW = 11
_HALF = WINDOW // 2
#: Its standard deviation, px.
SIGMA = 1.5
#: Stabilisers (0.01 L)^2 and (0.03 L)^2 for a data range L of 1.
C1, C2 = 0.01**2, 0.03**2
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


class LossConstants(NamedTuple):
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


@kernel
def find_content(worker, counters, ends, x, y, channels, content):
    """The part of each image outside of which both images are zero; a job is an image.

    Into int64 (B, 4): first and last row, first and last number of a row, the last ones excluded;
    zeros where all is zero.
    """
    height, size = x.shape[1:]
    seen = np.empty(size, np.bool_)
    for image in jobs(worker, counters, ends):
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
        store_lines(blurred, pad + j, stride, (x, y, xx, yy, xy))
    _clear_ends(blurred, pad, first, last)


@inline
def _clear_ends(blurred, pad, first, last):
    """Write zeros where windows reach beyond the sums."""
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
        sums = (_fill(_ZERO), _fill(_ZERO), _fill(_ZERO), _fill(_ZERO), _fill(_ZERO))
        for k in range(WINDOW):
            sums = add_lines(blurred, j + k * channels, stride, window[k], sums)
        x, y, xx, yy, xy = sums
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
        factors = (scale * of_mean, scale * ssim * share2, scale * (a1 * inverse) * (-_TWO))
        store_lines(made.factors, at + j, plane, factors)


@kernel
def compare(worker, counters, ends, images, channels, constants, made):
    """Errors of every row, and what their gradient is made of; a job is a row of an image.

    `made.factors` are filled within 5 px of the content only.
    """
    height, size = images.x.shape[1:]
    width = size // channels
    lambda_, c1, c2 = constants.dssim_weight, constants.c1, constants.c2
    blurred = np.empty((5, size + 2 * _HALF * channels), np.float32)
    spread, errors = np.empty(size, np.float32), np.empty(size, np.float32)
    # What rounding leaves of a pixel that is black in both.
    black = (_ONE - c1 * c2 * (_ONE / (c1 * c2))) * lambda_ * np.float32(channels)
    for job in jobs(worker, counters, ends):
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


@kernel
def gather(worker, counters, ends, images, channels, window, made, gradient):
    """The gradient by x. The window is symmetric and the border zero: it is its own adjoint.

    A job is a row of an image.
    """
    height, size = images.x.shape[1:]
    # Windows of pixels that are 10 px away from the content still reach the factors.
    pad = 2 * _HALF * channels
    blurred = np.empty((3, size + 2 * pad), np.float32)
    stride, plane = blurred.shape[1], made.direct.size
    for job in jobs(worker, counters, ends):
        image, row = job // height, job % height
        gradient[image, row] = _ZERO
        top, bottom, first, last = _grown(images.content, image, height, size, channels, _HALF)
        start, stop = max(top, row - _HALF), min(bottom, row + _HALF + 1)
        if start >= stop:
            continue
        for place in range(first, last, LANES):
            j = min(place, last - LANES)
            sums = (_fill(_ZERO), _fill(_ZERO), _fill(_ZERO))
            for k in range(start, stop):
                at = (image * height + k) * size + j
                sums = add_lines(made.factors, at, plane, window[k - row + _HALF], sums)
            store_lines(blurred, pad + j, stride, sums)
        _clear_ends(blurred, pad, first, last)
        first, last = max(0, first - pad // 2), min(size, last + pad // 2)
        for place in range(first, last, LANES):
            j = min(place, last - LANES)
            sums = (_fill(_ZERO), _fill(_ZERO), _fill(_ZERO))
            for k in range(WINDOW):
                at = pad // 2 + j + k * channels
                sums = add_lines(blurred, at, stride, window[k], sums)
            f0, f1, f2 = sums
            at = job * size + j
            x, y = _load(images.x, at), _load(images.y, at)
            store(gradient, at, _load(made.direct, at) + f0 + x * f1 * _TWO + y * f2)


# Values of an image that cost as much as one of the rasterizer's pairs.
_VALUES_LIKE_A_PAIR = 4


class PhotometricCpu(torch.autograd.Function):
    """See `wildghand.gaussians.losses.photometric_loss`, which checks the arguments."""

    @staticmethod
    def forward(
        ctx: Any,
        prediction: torch.Tensor,
        target: torch.Tensor,
        weights: torch.Tensor,
        dssim_weight: float,
    ) -> torch.Tensor:
        """Return the scalar loss; the gradients are made along with it."""
        count, height, width, channels = prediction.shape
        rows = (count, height, width * channels)
        x, y, w = (
            np.ascontiguousarray(tensor.detach().numpy())
            for tensor in (prediction, target, weights)
        )
        window = _window().astype(np.float32)
        constants = LossConstants(window, *map(np.float32, (dssim_weight, C1, C2, x.size)))
        images = Images(x.reshape(rows), y.reshape(rows), w, np.empty((count, 4), np.int64))
        made = Made(
            np.empty(w.shape, np.float32),
            np.empty((count, height)),
            np.empty(rows, np.float32),
            np.empty((3, *rows), np.float32),
        )
        work = x.size // _VALUES_LIKE_A_PAIR
        run_jobs(find_content, count, work // 4, images.x, images.y, channels, images.content)
        run_jobs(compare, count * height, work, images, channels, constants, made)
        if ctx.needs_input_grad[0]:
            ctx.gradient = np.empty_like(x)
            gradient = ctx.gradient.reshape(rows)
            run_jobs(gather, count * height, work, images, channels, window, made, gradient)
        ctx.save_for_backward(torch.from_numpy(made.errors))
        ctx.count = x.size
        return torch.tensor(made.sums.sum() / x.size, dtype=torch.float32)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Scale the gradients that `forward` has left."""
        (errors,) = ctx.saved_tensors
        to_prediction = to_weights = None
        if ctx.needs_input_grad[0]:
            to_prediction = torch.from_numpy(ctx.gradient) * upstream
        if ctx.needs_input_grad[2]:
            to_weights = errors * (upstream / ctx.count)
        return to_prediction, None, to_weights, None


def ssim_map(prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Structural similarity at every pixel and channel.

    Half precision is computed and returned in float32: its variances would be rounding alone.
    The window is a Gaussian of 11 px and sigma 1.5; population covariance; data range 1; beyond
    the border both images are 0. The gradient goes to `prediction` only.

    Args:
        prediction: (B, H, W, C) float.
        target: (B, H, W, C) float of the same type.

    Returns:
        (B, H, W, C) in [-1, 1].

    Raises:
        ShapeMismatch: the two differ in shape.

    Source: Wang et al., "Image quality assessment: from error visibility to structural
    similarity", equation 13; zero padding as in 3DGS.
    """
    _same_shape(prediction, target, "target")
    x, y = full_precision(prediction), full_precision(target).detach()
    means = _blur(torch.cat((x, y, x * x, y * y, x * y), dim=-1))
    mu_x, mu_y, xx, yy, xy = means.split(x.shape[-1], dim=-1)
    products, squares = mu_x * mu_y, mu_x * mu_x + mu_y * mu_y
    # Rounding may push a variance below 0; the sum must stay away from it.
    spreads = (xx + yy - squares).clamp(min=0.0)
    above = (2.0 * products + C1) * (2.0 * (xy - products) + C2)
    return above / ((squares + C1) * (spreads + C2))


def photometric_loss(
    prediction: torch.Tensor,
    target: torch.Tensor,
    weights: torch.Tensor,
    dssim_weight: float,
) -> torch.Tensor:
    """(1 - lambda) L1 + lambda (1 - SSIM), weighted by pixel, averaged over pixels and channels.

    Args:
        prediction: (B, H, W, C) float, sRGB in [0, 1].
        target: (B, H, W, C), as `prediction`.
        weights: (B, H, W) not negative.
        dssim_weight: lambda in [0, 1]; with 0 only L1 is computed.

    Returns:
        scalar, float32 for half precision: the weighted sum divided by the number of values
        B H W C, so that a pixel counts the same in every frame. Differentiable in `prediction`
        and `weights`.

    Raises:
        ShapeMismatch: the three do not describe the same images.

    Source: Kerbl et al., "3D Gaussian Splatting", equation 7.
    """
    _same_shape(prediction, target, "target")
    if weights.shape != prediction.shape[:3]:
        raise ShapeMismatch(
            f"has shape {tuple(weights.shape)}, expected {tuple(prediction.shape[:3])}",
            field="weights",
        )
    images = [full_precision(tensor) for tensor in (prediction, target, weights)]
    prediction, target, weights = images
    wide = prediction.shape[2] * prediction.shape[3] >= LANES
    if dssim_weight > 0.0 and wide and kernels_take(*images):
        return PhotometricCpu.apply(*images, dssim_weight)
    error = (prediction - target).abs()
    if dssim_weight > 0.0:
        dissimilarity = 1.0 - ssim_map(prediction, target)
        error = (1.0 - dssim_weight) * error + dssim_weight * dissimilarity
    return (error * weights[..., None]).mean()


def full_precision(values: torch.Tensor) -> torch.Tensor:
    """Half precision as float32; gradients come back in the type that was given."""
    return values.float() if values.element_size() < 4 else values


def _blur(images: torch.Tensor) -> torch.Tensor:
    """Blur (B, H, W, C) with the SSIM window over a zero border."""
    window = _window_on(images.device, images.dtype)
    channels, planes = images.shape[-1], images.permute(0, 3, 1, 2)
    for size, padding in (((WINDOW, 1), (_HALF, 0)), ((1, WINDOW), (0, _HALF))):
        kernel = window.reshape(1, 1, *size).expand(channels, 1, *size)
        planes = torch.nn.functional.conv2d(planes, kernel, padding=padding, groups=channels)
    return planes.permute(0, 2, 3, 1)


@functools.cache
def _window() -> np.ndarray:
    places = np.arange(WINDOW) - _HALF
    window = np.exp(-0.5 * (places / SIGMA) ** 2)
    return window / window.sum()


@functools.cache
def _window_on(device: torch.device, dtype: torch.dtype) -> torch.Tensor:
    return torch.as_tensor(_window(), dtype=dtype, device=device)


def _same_shape(prediction: torch.Tensor, other: torch.Tensor, field: str) -> None:
    if prediction.dim() != 4 or prediction.shape != other.shape:
        raise ShapeMismatch(
            f"has shape {tuple(other.shape)}, the prediction {tuple(prediction.shape)}; "
            "both must be (B, H, W, C)",
            field=field,
        )
