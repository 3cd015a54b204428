"""How far Gaussians are from flat, opaque discs that lie on the skin and close it.

A picture says nothing of the side of the hand that it does not show, nor how far a Gaussian that
faces the camera reaches along the line of sight, nor whether the one behind it is there at all.
What no frame contradicts should look like skin from everywhere: no holes and no fur.
"""

from __future__ import annotations

import math

from torch import Tensor, relu, stack
from torch.nn.functional import normalize

from wildghand.gaussians.attributes import Activation, RawAttributes
from wildghand.splat.threads import kernels_take

# What costs nothing. Lengths in spacings of the anchors: how far a Gaussian reaches off the skin
# (its distance and two standard deviations), how far it lies from its anchor along the skin, its
# least and largest standard deviation along the skin; and its opacity. Two standard deviations off
# the skin, where thickness costs.
_REACH, _SHIFT, _NARROW, _WIDE, _OPAQUE, _THICK = 0.8, 0.5, 0.6, 1.5, 0.98, 0.4
# Weight of the opacity: a hole in spacings.
_HOLE = 4.0
# Squares of lengths below this have no slope, in spacings.
_TINY = 1e-8


def off_surface(
    raw: RawAttributes, activation: Activation, spacing: float, *, flatness: float = 0.0
) -> Tensor:
    """Mean over Gaussians and frames of what keeps them from closing the surface.

    Args:
        raw: (B, N, k) attributes.
        activation: of them.
        spacing: mean distance between neighbouring anchors, m.
        flatness: weight of what is thicker than a disc, wherever it lies. Where a finger is drawn
            at wrong places, Gaussians otherwise become needles off its skin, which look like fur.

    Returns:
        scalar: the sum of squares beyond what costs nothing, of lengths in spacings, of the log of
        a width, and of opacity.
    """
    if kernels_take(*(tensor for _, tensor in raw.items())):
        from wildghand.gaussians.closed_surface_cpu import OffSurfaceCpu

        free = (_REACH, _SHIFT, math.log(_NARROW), _WIDE, _OPAQUE, _HOLE, _THICK, flatness)
        return OffSurfaceCpu.apply(raw.concatenate(), activation, spacing, free, _TINY)
    rows = _tangents(raw.quats)
    drawn = activation(raw)
    squares = (drawn.scales / spacing).square()
    xx, yy, xy = ((squares * rows[i] * rows[j]).sum(dim=-1) for i, j in ((0, 0), (1, 1), (0, 1)))
    across = xx + yy
    # The trace does not change when a Gaussian turns.
    along = (squares.sum(dim=-1) - across).clamp(min=_TINY)
    area = (xx * yy - xy * xy).clamp(min=_TINY)
    offsets = drawn.offsets / spacing
    shift = (offsets[..., :2].square().sum(dim=-1) + _TINY).sqrt()
    thickness = 2.0 * along.sqrt()
    cost = relu(offsets[..., 2].abs() + thickness - _REACH).square()
    cost = cost + flatness * relu(thickness - _THICK).square()
    cost = cost + relu(shift - _SHIFT).square()
    cost = cost + relu(math.log(_NARROW) - 0.25 * area.log()).square()
    cost = cost + relu((across + _TINY).sqrt() - _WIDE).square()
    cost = cost + _HOLE * relu(_OPAQUE - drawn.opacities).square()
    return cost.mean()


def _tangents(quats: Tensor) -> tuple[Tensor, Tensor]:
    """The two rows (..., 3) of a Gaussian's rotation that lie in the skin; any length but 0."""
    w, x, y, z = normalize(quats, dim=-1).unbind(-1)
    first = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y))
    second = (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x))
    return stack(first, dim=-1), stack(second, dim=-1)
