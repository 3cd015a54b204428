"""`wildghand.gaussians.closed_surface` on the CPU: cost and gradient in one compiled pass."""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from hwp_bench.base.kernels import compiled
from wildghand.splat.kernels.jobs import next_job

#: Gaussians that one thread takes at a time.
PIECE = 512
_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_FOUR = np.float32(4.0)


@compiled(nogil=True)
def off_surface(worker, counters, ends, raw, lengths, log_scales, free, tiny, made, costs):
    """Cost of the Gaussians of all frames, and its gradient.

    Args:
        worker, counters, ends: see `wildghand.splat.threads.run`; a job is `PIECE` Gaussians.
        raw: (B N, 14) float32.
        lengths: (2,) float32 m: largest displacement, and spacing of the anchors.
        log_scales: (3,) float32: bias, least and greatest of the log scales.
        free: (8,) float32 what costs nothing: reach, shift, logarithm of the least width, greatest
            width, opacity; the weight of the opacity; the thickness that costs nothing, and the
            weight of the thickness.
        tiny: float32 below which squares of lengths have no slope.
        made: (B N, 14) float32, filled: gradient of the sum of all costs.
        costs: (pieces,) float64, filled: their sum over a piece.
    """
    count = len(raw)
    reach, aside, narrow, wide = free[0], free[1], free[2], free[3]
    bound = lengths[0] / lengths[1]
    squares, moved = np.empty(3, np.float32), np.empty(3, np.float32)
    first, second = np.empty(3, np.float32), np.empty(3, np.float32)
    of_first, of_second = np.empty(3, np.float32), np.empty(3, np.float32)
    job = next_job(worker, counters, ends)
    while job >= 0:
        total = 0.0
        for n in range(PIECE * job, min(PIECE * (job + 1), count)):
            given, found = raw[n], made[n]
            for i in range(3):
                moved[i] = np.float32(math.tanh(_HALF * given[i]))
                value = min(max(given[3 + i] + log_scales[0], log_scales[1]), log_scales[2])
                squares[i] = (np.float32(math.exp(value)) / lengths[1]) ** 2
            # As torch's normalize: the length is at least 1e-12.
            w, x, y, z = given[6], given[7], given[8], given[9]
            inverse = _ONE / max(np.sqrt(w * w + x * x + y * y + z * z), np.float32(1e-12))
            w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
            first[0] = _ONE - _TWO * (y * y + z * z)
            first[1] = _TWO * (x * y - w * z)
            first[2] = _TWO * (x * z + w * y)
            second[0] = _TWO * (x * y + w * z)
            second[1] = _ONE - _TWO * (x * x + z * z)
            second[2] = _TWO * (y * z - w * x)
            xx, yy, xy, trace = _ZERO, _ZERO, _ZERO, _ZERO
            for i in range(3):
                xx += squares[i] * first[i] * first[i]
                yy += squares[i] * second[i] * second[i]
                xy += squares[i] * first[i] * second[i]
                trace += squares[i]
            across, along, area = xx + yy, trace - (xx + yy), xx * yy - xy * xy
            off = bound * moved[2]
            root = np.sqrt(max(along, tiny))
            reaching = max(abs(off) + _TWO * root - reach, _ZERO)
            thick = max(_TWO * root - free[6], _ZERO)
            right, up = bound * moved[0], bound * moved[1]
            distance = np.sqrt(right * right + up * up + tiny)
            shifted = max(distance - aside, _ZERO)
            width = np.sqrt(across + tiny)
            too_narrow = max(narrow - _HALF * _HALF * np.float32(math.log(max(area, tiny))), _ZERO)
            too_wide = max(width - wide, _ZERO)
            opacity = _ONE / (_ONE + np.float32(math.exp(-given[10])))
            clear = max(free[4] - opacity, _ZERO)
            total += reaching * reaching + shifted * shifted + too_narrow * too_narrow
            total += too_wide * too_wide + free[5] * clear * clear + free[7] * thick * thick
            # The gradient, from the costs back to the channels.
            of_along = _TWO * (reaching + free[7] * thick) / root if along >= tiny else _ZERO
            of_area = -_HALF * too_narrow / area if area >= tiny else _ZERO
            of_across = too_wide / width - of_along
            of_xx, of_yy = of_area * yy + of_across, of_area * xx + of_across
            of_xy = -_TWO * xy * of_area
            for i in range(3):
                q, a, b = squares[i], first[i], second[i]
                of_square = of_along + of_xx * a * a + of_yy * b * b + of_xy * a * b
                value = given[3 + i] + log_scales[0]
                inside = log_scales[1] <= value and value <= log_scales[2]
                found[3 + i] = _TWO * q * of_square if inside else _ZERO
                of_first[i] = q * (_TWO * of_xx * a + of_xy * b)
                of_second[i] = q * (_TWO * of_yy * b + of_xy * a)
            a, b, c = of_first[0], of_first[1], of_first[2]
            d, e, f = of_second[0], of_second[1], of_second[2]
            of_w = _TWO * (y * c - z * b + z * d - x * f)
            of_x = _TWO * (y * b + z * c + y * d - w * f) - _FOUR * x * e
            of_y = _TWO * (x * b + w * c + x * d + z * f) - _FOUR * y * a
            of_z = _TWO * (x * c - w * b + w * d + y * f) - _FOUR * z * (a + e)
            radial = w * of_w + x * of_x + y * of_y + z * of_z
            found[6] = inverse * (of_w - radial * w)
            found[7] = inverse * (of_x - radial * x)
            found[8] = inverse * (of_y - radial * y)
            found[9] = inverse * (of_z - radial * z)
            sideways = _TWO * shifted / distance
            found[0] = sideways * right * _HALF * bound * (_ONE - moved[0] * moved[0])
            found[1] = sideways * up * _HALF * bound * (_ONE - moved[1] * moved[1])
            sign = _ZERO if off == _ZERO else (_ONE if off > _ZERO else -_ONE)
            found[2] = _TWO * reaching * sign * _HALF * bound * (_ONE - moved[2] * moved[2])
            found[10] = -_TWO * free[5] * clear * opacity * (_ONE - opacity)
            for i in range(11, 14):
                found[i] = _ZERO
        costs[job] = total
        job = next_job(worker, counters, ends)
