"""From the gradients of each (splat, tile) to those of each projected Gaussian.

Every pair owns its slot, so threads share nothing, and each Gaussian adds its slots in the
order of its tiles: the sums are the same bits on every run.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from wildghand.splat.kernels import geometry as at
from wildghand.splat.kernels.channels import MOMENTS
from wildghand.splat.kernels.jit import kernel
from wildghand.splat.kernels.lanes import atomic_next, prefetch
from wildghand.splat.kernels.project import PIECE

_AHEAD = 24
_TWO_LN2 = 2.0 * math.log(2.0)


@kernel
def reduce_slots(
    counter, gaussians, channels, geom, opacities, opacity_share, color_share, first_entry,
    depths, slot_of, slots, slot_size, v_means2d, v_shapes, v_opacities, v_colors,
):  # fmt: skip
    """Gradients of the projected Gaussians, summed over images for what images share.

    Args:
        counter: int64 (1,), 0; shared by the threads.
        gaussians, channels: N and D.
        geom: flat float32 (I, N, 16).
        opacities: flat float32 (S, N), as blended.
        opacity_share, color_share: int64 (I,); which of the S entries an image reads.
        first_entry: int32 (I * N + 1,); see `bins`.
        depths: float32 (I, N); 0 where culled.
        slot_of: int32 (E,); slot of each entry, -1 if nothing of it was blended.
        slots: flat float32, `slot_size` for each; see `channels.finish_sums`.
        v_means2d: out, flat float32 (I, N, 2); px^-1.
        v_shapes: out, flat float32 (I, N, 3); with the exponent -1/2 (a u^2 + c e^2), u = dx +
            s dy, e = dy: gradient of log a, of log c, of s times sqrt(c / a). They have no unit,
            so they fit into float32 for every size of splat.
        v_opacities, v_colors: in zeros, out, flat float32 (S, N) and (S, N, D).
    """
    images = depths.shape[0]
    pieces = max(1, gaussians // PIECE)
    color = np.empty(channels, np.float64)
    while True:
        piece = atomic_next(counter)
        if piece >= pieces:
            break
        for i in range(images):
            for n in range(piece * gaussians // pieces, (piece + 1) * gaussians // pieces):
                to = i * gaussians + n
                m = m_u = m_e = m_uu = m_ue = m_ee = 0.0
                color[:] = 0.0
                if depths[i, n] > 0:
                    for entry in range(first_entry[to], first_entry[to + 1]):
                        if entry + _AHEAD < slot_of.size:
                            prefetch(slots, np.int64(slot_of[entry + _AHEAD]) * slot_size)
                        slot = np.int64(slot_of[entry])
                        if slot < 0:
                            continue
                        f = slot * slot_size
                        m += slots[f]
                        m_u += slots[f + 1]
                        m_e += slots[f + 2]
                        m_uu += slots[f + 3]
                        m_ue += slots[f + 4]
                        m_ee += slots[f + 5]
                        for k in range(channels):
                            color[k] += slots[f + MOMENTS + k]
                    row = to * at.ROW
                    along = np.float64(geom[row + at.ALONG])
                    across = np.float64(geom[row + at.ACROSS])
                    shear = np.float64(geom[row + at.SHEAR]) + np.float64(geom[row + at.SHEAR_LOW])
                    v_x = _TWO_LN2 * along * m_u
                    v_means2d[2 * to] = v_x
                    v_means2d[2 * to + 1] = _TWO_LN2 * across * m_e + shear * v_x
                    v_shapes[3 * to] = -0.5 * _TWO_LN2 * m_uu
                    v_shapes[3 * to + 1] = -0.5 * _TWO_LN2 * m_ee
                    v_shapes[3 * to + 2] = -_TWO_LN2 * m_ue
                    share = opacity_share[i] * gaussians + n
                    v_opacities[share] += m / opacities[share]
                    share = (color_share[i] * gaussians + n) * channels
                    for k in range(channels):
                        v_colors[share + k] += color[k]
                else:
                    v_means2d[2 * to] = 0.0
                    v_means2d[2 * to + 1] = 0.0
                    for k in range(3):
                        v_shapes[3 * to + k] = 0.0
