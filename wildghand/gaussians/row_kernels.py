"""Loops over rows of a table, compiled: sums of other rows, and spherical harmonics."""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np
from numba import types

from hwp_bench.base.kernels import compiled
from wildghand.splat.kernels.jobs import next_job
from wildghand.splat.kernels.lanes import make_fill, make_load, store
from wildghand.splat.kernels.simd import Vector

#: Rows that one thread takes at a time.
PIECE = 512
#: Channels that are summed together.
LANES = 16

_FLOATS = Vector(types.float32, LANES)
_load = make_load(_FLOATS)
_fill = make_fill(_FLOATS)

_A, _B, _C, _D = (np.float32(math.sqrt(number)) for number in (15.0, 17.5, 10.5, 105.0))
_THREE, _FIVE, _SEVEN = (np.float32(math.sqrt(number)) for number in (3.0, 5.0, 7.0))
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)


@compiled(nogil=True)
def sum_bags(worker, counters, ends, values, index, weight, start, out):
    """See `wildghand.gaussians.bags.sum_bags`; a job is `PIECE` rows."""
    rows, channels = out.shape
    room = np.zeros(LANES, np.float32)
    job = next_job(worker, counters, ends)
    while job >= 0:
        for row in range(PIECE * job, min(PIECE * (job + 1), rows)):
            first, last = start[row], start[row + 1] if row + 1 < rows else len(index)
            if channels < LANES:
                sums = _fill(np.float32(0.0))
                for term in range(first, last):
                    at = index[term] * channels
                    if at + LANES <= values.size:
                        sums = sums + _load(values, at) * weight[term]
                    else:  # nothing behind the last row is read
                        for c in range(channels):
                            room[c] = values[index[term], c]
                        sums = sums + _load(room, 0) * weight[term]
                store(room, 0, sums)
                for c in range(channels):
                    out[row, c] = room[c]
                continue
            for place in range(0, channels, LANES):
                # The last vector begins where it ends with the row.
                c = min(place, channels - LANES)
                sums = _fill(np.float32(0.0))
                for term in range(first, last):
                    sums = sums + _load(values, index[term] * channels + c) * weight[term]
                store(out, row * channels + c, sums)
        job = next_job(worker, counters, ends)


@compiled(nogil=True)
def fill_harmonics(worker, counters, ends, normals, degree, out, first):
    """See `wildghand.gaussians.shading_cpu.fill_harmonics`; a job is `PIECE` normals."""
    three, five = np.float32(3.0), np.float32(5.0)
    job = next_job(worker, counters, ends)
    while job >= 0:
        for row in range(PIECE * job, min(PIECE * (job + 1), len(normals))):
            x, y, z = normals[row, 0], normals[row, 1], normals[row, 2]
            o = out[row, first:]
            o[0], o[1], o[2] = _THREE * x, _THREE * y, _THREE * z
            if degree >= 2:
                o[3], o[4], o[5] = _A * x * y, _A * y * z, _A * x * z
                o[6] = _HALF * _A * (x * x - y * y)
                o[7] = _HALF * _FIVE * (three * z * z - _ONE)
            if degree >= 3:
                fifth = five * z * z - _ONE
                o[8] = _HALF * _B * y * (three * x * x - y * y)
                o[9] = _D * x * y * z
                o[10] = _HALF * _C * y * fifth
                o[11] = _HALF * _SEVEN * z * (five * z * z - three)
                o[12] = _HALF * _C * x * fifth
                o[13] = _HALF * _D * z * (x * x - y * y)
                o[14] = _HALF * _B * x * (x * x - three * y * y)
        job = next_job(worker, counters, ends)
