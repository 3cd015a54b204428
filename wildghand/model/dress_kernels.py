"""From raw attributes to Gaussians in the world on the CPU, compiled, and the gradient.

One Gaussian at a time: the bias of DPD, the activation, and the motion of its anchor.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from hwp_bench.base.kernels import compiled
from wildghand.splat.kernels.jit import next_job

#: Gaussians that one thread takes at a time.
PIECE = 512
#: First channel of each attribute, and the first behind it: DPD maps an attribute onto itself.
_BLOCKS = ((0, 3), (3, 6), (6, 10), (10, 11), (11, 14))
_ONE, _TWO, _HALF = np.float32(1.0), np.float32(2.0), np.float32(0.5)
_ZERO = np.float32(0.0)


@compiled(nogil=True)
def _sigmoid(x):
    # The argument of the exponential is never positive: no overflow.
    small = np.float32(math.exp(-abs(x)))
    made = _ONE / (_ONE + small)
    return made if x >= _ZERO else small * made


@compiled(nogil=True)
def dress_pieces(
    worker, counters, ends, raw, mixing, shift, field, omega, biased, bound, log_scales, moved,
    shadow, positions, orientations, active, means, quats, scales, opacities, colors, sizes,
):  # fmt: skip
    """Make the Gaussians of B frames.

    Args:
        raw: (B, N, 14) float32.
        mixing: (14, 14) float32, of which the blocks of the attributes are read; shift: (B, 14).
            The bias of frame b is omega[b] (mixing g + shift[b] + field[b]).
        field: (B, N, 14) float32; or (B, 0, 14), which stands for zeros.
        omega: (B,) float32; biased: (B,) bool, whether a frame has biases at all.
        bound: largest displacement, m.
        log_scales: (3,) float32: bias, least and greatest of the log scales.
        moved: (N, 3) m, displacement of the template in the anchors' frames.
        shadow: (B, N) float32.
        positions: (B, N, 3) m; orientations: (B, N, 4) of length 1.
        active: (B, N, 12) float32, filled for the gradient: displacement as a share of the bound
            (3), unit quaternion (4), 1 / its length before, colours (3), and in bits of one
            number which scales are within their limits.
        means, quats, scales, opacities, colors: (B, N, k) float32, filled.
    """
    frames, count, local = raw.shape[0], raw.shape[1], field.shape[1] > 0
    given, bias = np.empty(14, np.float32), np.empty(14, np.float32)
    job = next_job(worker, counters, ends)
    while job >= 0:
        size = 0.0
        for b in range(frames):
            for n in range(PIECE * job, min(PIECE * (job + 1), count)):
                for i in range(14):
                    given[i] = raw[b, n, i]
                    bias[i] = _ZERO
                if biased[b]:
                    for start, stop in _BLOCKS:
                        for i in range(start, stop):
                            value = shift[b, i]
                            if local:
                                value += field[b, n, i]
                            for k in range(start, stop):
                                value += mixing[i, k] * given[k]
                            bias[i] = omega[b] * value
                    for i in range(14):
                        size += abs(bias[i])
                        given[i] += bias[i]
                kept = active[b, n]
                # tanh(x / 2) = 2 sigmoid(x) - 1
                for i in range(3):
                    kept[i] = _TWO * _sigmoid(given[i]) - _ONE
                x = bound * kept[0] + moved[n, 0]
                y = bound * kept[1] + moved[n, 1]
                z = bound * kept[2] + moved[n, 2]
                inside = _ZERO
                for i in range(3):
                    value = given[3 + i] + log_scales[0]
                    if value < log_scales[1]:
                        value = log_scales[1]
                    elif value > log_scales[2]:
                        value = log_scales[2]
                    else:
                        inside += np.float32(1 << i)
                    scales[b, n, i] = math.exp(value)
                squared = _ZERO
                for i in range(4):
                    squared += given[6 + i] * given[6 + i]
                # As torch's normalize: the length is at least 1e-12.
                inverse = _ONE / max(np.sqrt(squared), np.float32(1e-12))
                for i in range(4):
                    kept[3 + i] = given[6 + i] * inverse
                kept[7] = inverse
                opacities[b, n] = _sigmoid(given[10])
                for i in range(3):
                    kept[8 + i] = _sigmoid(given[11 + i])
                    colors[b, n, i] = kept[8 + i] * shadow[b, n]
                kept[11] = inside
                w, u, v, t = (
                    orientations[b, n, 0],
                    orientations[b, n, 1],
                    orientations[b, n, 2],
                    orientations[b, n, 3],
                )
                p, q, r = (
                    _TWO * (v * z - t * y),
                    _TWO * (t * x - u * z),
                    _TWO * (u * y - v * x),
                )
                means[b, n, 0] = positions[b, n, 0] + x + w * p + v * r - t * q
                means[b, n, 1] = positions[b, n, 1] + y + w * q + t * p - u * r
                means[b, n, 2] = positions[b, n, 2] + z + w * r + u * q - v * p
                e, f, g, h = kept[3], kept[4], kept[5], kept[6]
                quats[b, n, 0] = w * e - u * f - v * g - t * h
                quats[b, n, 1] = w * f + u * e + v * h - t * g
                quats[b, n, 2] = w * g - u * h + v * e + t * f
                quats[b, n, 3] = w * h + u * g - v * f + t * e
        sizes[job] = size
        job = next_job(worker, counters, ends)


@compiled(nogil=True)
def dress_pieces_backward(
    worker, counters, ends, raw, mixing, shift, field, omega, biased, share, bound, shadow,
    orientations, active, scales, opacities, of_means, of_quats, of_scales, of_opacities, of_colors,
    of_size, of_raw, of_moved, of_shadow, of_mixing, of_shift, of_field, of_omega,
):  # fmt: skip
    """Gradients of `dress_pieces`; `means` have that of the positions.

    Args:
        share: (B,) float32, weight of each frame in the gradients that all frames share.
        of_raw: (B, N, 14), of_moved: (N, 3), of_shadow: (B, N) float32, filled.
        of_field: as `field`, float32, filled.
        of_mixing: (pieces, 14, 14), of_shift: (pieces, B, 14), of_omega: (pieces, B) float32
            zeros, to which each piece adds its part.
    """
    frames, count, local = raw.shape[0], raw.shape[1], field.shape[1] > 0
    given, top, unmixed = (
        np.empty(14, np.float32),
        np.empty(14, np.float32),
        np.empty(14, np.float32),
    )
    job = next_job(worker, counters, ends)
    while job >= 0:
        for n in range(PIECE * job, min(PIECE * (job + 1), count)):
            of_moved[n, 0] = of_moved[n, 1] = of_moved[n, 2] = _ZERO
        for b in range(frames):
            for n in range(PIECE * job, min(PIECE * (job + 1), count)):
                kept = active[b, n]
                w, u, v, t = (
                    orientations[b, n, 0],
                    -orientations[b, n, 1],
                    -orientations[b, n, 2],
                    -orientations[b, n, 3],
                )
                x, y, z = of_means[b, n, 0], of_means[b, n, 1], of_means[b, n, 2]
                p, q, r = (
                    _TWO * (v * z - t * y),
                    _TWO * (t * x - u * z),
                    _TWO * (u * y - v * x),
                )
                x, y, z = (
                    x + w * p + v * r - t * q,
                    y + w * q + t * p - u * r,
                    z + w * r + u * q - v * p,
                )
                of_moved[n, 0] += share[b] * x
                of_moved[n, 1] += share[b] * y
                of_moved[n, 2] += share[b] * z
                half = _HALF * bound
                top[0] = half * x * (_ONE - kept[0] * kept[0])
                top[1] = half * y * (_ONE - kept[1] * kept[1])
                top[2] = half * z * (_ONE - kept[2] * kept[2])
                inside = int(kept[11])
                for i in range(3):
                    top[3 + i] = of_scales[b, n, i] * scales[b, n, i] if inside >> i & 1 else _ZERO
                e, f, g, h = (
                    of_quats[b, n, 0],
                    of_quats[b, n, 1],
                    of_quats[b, n, 2],
                    of_quats[b, n, 3],
                )
                top[6] = w * e - u * f - v * g - t * h
                top[7] = w * f + u * e + v * h - t * g
                top[8] = w * g - u * h + v * e + t * f
                top[9] = w * h + u * g - v * f + t * e
                along = _ZERO
                for i in range(4):
                    along += top[6 + i] * kept[3 + i]
                for i in range(4):
                    top[6 + i] = (top[6 + i] - along * kept[3 + i]) * kept[7]
                opacity = opacities[b, n]
                top[10] = of_opacities[b, n] * opacity * (_ONE - opacity)
                across = _ZERO
                for i in range(3):
                    color, grad = kept[8 + i], of_colors[b, n, i]
                    across += grad * color
                    top[11 + i] = grad * shadow[b, n] * color * (_ONE - color)
                of_shadow[b, n] = share[b] * across
                if not biased[b]:
                    for i in range(14):
                        of_raw[b, n, i] = share[b] * top[i]
                        if local:
                            of_field[b, n, i] = _ZERO
                    continue
                for i in range(14):
                    given[i] = raw[b, n, i]
                    unmixed[i] = top[i]
                for start, stop in _BLOCKS:
                    for i in range(start, stop):
                        value = shift[b, i]
                        if local:
                            value += field[b, n, i]
                        for k in range(start, stop):
                            value += mixing[i, k] * given[k]
                        grad = top[i]
                        bias = omega[b] * value
                        if bias > _ZERO:
                            grad += of_size
                        elif bias < _ZERO:
                            grad -= of_size
                        of_omega[job, b] += grad * value
                        grad *= omega[b]
                        of_shift[job, b, i] += grad
                        if local:
                            of_field[b, n, i] = grad
                        for k in range(start, stop):
                            of_mixing[job, i, k] += grad * given[k]
                            unmixed[k] += grad * mixing[i, k]
                for i in range(14):
                    of_raw[b, n, i] = share[b] * unmixed[i]
        job = next_job(worker, counters, ends)
