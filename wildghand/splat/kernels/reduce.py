"""From the gradients of each (splat, tile) to those of each projected Gaussian.

Every pair owns its slot, so threads share nothing, and each Gaussian adds its slots in the
order of its tiles: the sums are the same bits on every run.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from wildghand.splat.kernels import geometry as at
from wildghand.splat.kernels.channels import MOMENTS
from wildghand.splat.kernels.jit import inline, kernel
from wildghand.splat.kernels.jobs import next_job
from wildghand.splat.kernels.lanes import prefetch, store
from wildghand.splat.kernels.project import PIECE, entry_of
from wildghand.splat.kernels.project_backward import clear_first
from wildghand.splat.kernels.rows import GROUP, fill_exact, load1

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
        worker, counters, ends: see `next_job`; a job is a piece of Gaussians.
        geom, depths: of `Projected`.
        opacities: float32 (S, N), as blended.
        first_entry: int32 (I * N + 1,); see `bins`.
        slot_of: int32 (E,); slot of each entry, -1 if nothing of it was blended.
        slots: float32, a row for each; see `channels.finish_sums`.
        gradients: out, `BlendGradients`.
    """
    images, gaussians = depths.shape
    v_means2d, v_shapes, v_opacities, v_colors = gradients
    channels = v_colors.shape[2]
    pieces = max(1, gaussians // PIECE)
    groups = (MOMENTS + channels + GROUP - 1) // GROUP
    sums = np.empty(groups * GROUP, np.float64)
    while True:
        piece = next_job(worker, counters, ends)
        if piece < 0:
            break
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
