"""Penalties that keep Gaussians even and closed over the skin: a Laplacian, and flat opaque discs.

A picture says nothing of the side of the hand that it does not show, nor how far a Gaussian that
faces the camera reaches along the line of sight, nor whether the one behind it is there at all.
What no frame contradicts should look like skin from everywhere: no holes and no fur.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, relu, stack

from hwp_bench.base.errors import ShapeMismatch
from hwp_bench.base.numerics import kd_tree
from hwp_bench.hands.anchors import anchor_frames, anchor_positions
from wildghand.gaussians.attributes import Activation, RawAttributes
from wildghand.gaussians.rig import HandRig

#: Neighbours of each anchor.
NEIGHBOURS = 6
# Candidates for each neighbour: some lie on the other side of a finger.
_CANDIDATES = 3


@dataclass(frozen=True, eq=False)
class SurfaceLaplacian:
    """Value minus the mean of its neighbours, for N anchors."""

    #: (N, N) sparse CSR.
    matrix: Tensor
    #: (N, N) sparse CSR, its transpose, for the gradient.
    transposed: Tensor
    #: (N, 3, 3) anchor frames on the rest surface.
    frames: Tensor
    #: Mean distance between neighbouring anchors, m.
    spacing: float

    def __call__(self, values: Tensor) -> Tensor:
        """Differences of (..., N, C) to the neighbours' mean, in the matrix's type."""
        count = len(self.matrix)
        if values.ndim < 2 or values.shape[-2] != count:
            raise ShapeMismatch(
                f"has shape {tuple(values.shape)}, expected (..., {count}, C)", field="values"
            )
        rows = values.movedim(-2, 0).reshape(count, -1).to(self.matrix.dtype)
        made = _Product.apply(rows, self.matrix, self.transposed)
        return made.reshape(count, *values.shape[:-2], values.shape[-1]).movedim(0, -2)

    def roughness(self, values: Tensor) -> Tensor:
        """Mean over anchors (and frames) of the squared length of the difference."""
        return self(values).square().sum(dim=-1).mean()

    def offsets(self, offsets: Tensor) -> Tensor:
        """Roughness of displacements (..., N, 3) m in the anchors' frames.

        They are compared in the axes of the rest pose and in units of the spacing: the tangents of
        neighbouring anchor frames may point anywhere.
        """
        turned = (self.frames.to(offsets) @ offsets.unsqueeze(-1)).squeeze(-1)
        return self.roughness(turned / self.spacing)


def surface_laplacian(
    rig: HandRig, neighbours: int = NEIGHBOURS, dtype: torch.dtype = torch.float32
) -> SurfaceLaplacian:
    """Connect each anchor of a hand with its nearest neighbours on the rest surface.

    Neighbours are nearest in space among those whose normals agree, so that neither the two
    sides of a finger nor two fingers that touch are connected. All weigh the same.

    Args:
        rig: the hand and its anchors.
        neighbours: of each anchor; fewer where there are fewer anchors.
        dtype: of the values that will be given.
    """
    frames = anchor_frames(rig.template.vertices, rig.template.faces, rig.anchors)
    matrix = _difference_matrix(nearest_on_surface(*rest_anchors(rig), neighbours))
    device = frames.device

    def sparse(scipy_matrix: Any) -> Tensor:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")
            return torch.sparse_csr_tensor(
                torch.from_numpy(scipy_matrix.indptr.astype(np.int64)),
                torch.from_numpy(scipy_matrix.indices.astype(np.int64)),
                torch.from_numpy(scipy_matrix.data).to(dtype),
                size=scipy_matrix.shape,
                device=device,
                check_invariants=True,
            )

    return SurfaceLaplacian(sparse(matrix), sparse(matrix.T.tocsr()), frames, rig.spacing)


def rest_anchors(rig: HandRig) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) positions, m, and (N, 3) unit normals of the anchors on the rest surface."""
    vertices, faces = rig.template.vertices, rig.template.faces
    positions = anchor_positions(vertices, faces, rig.anchors)
    normals = anchor_frames(vertices, faces, rig.anchors)[..., 2]
    return positions.cpu().numpy(), normals.cpu().numpy()


def nearest_on_surface(positions: np.ndarray, normals: np.ndarray, count: int) -> np.ndarray:
    """The nearest points whose normals differ by less than a right angle.

    (N, K) int64, K = count or N - 1 if that is less; -1 where fewer agree.
    """
    total = len(positions)
    found = min(count, total - 1)
    candidates = min(_CANDIDATES * count + 1, total)
    _, near = kd_tree(positions).query(positions, k=candidates)
    near = near.reshape(total, candidates)
    agree = np.einsum("nc,nkc->nk", normals, normals[near]) > 0.0
    agree &= near != np.arange(total)[:, None]
    order = np.argsort(~agree, axis=1, kind="stable")[:, :found]
    chosen = np.take_along_axis(near, order, axis=1)
    return np.where(np.take_along_axis(agree, order, axis=1), chosen, -1)


def _difference_matrix(near: np.ndarray) -> Any:
    """Identity minus the neighbours' mean; a row without neighbours is zero."""
    from scipy.sparse import csr_array

    total = len(near)
    counts = (near >= 0).sum(axis=1)
    rows, places = np.nonzero(near >= 0)
    own = np.where(counts > 0, 1.0, 0.0)
    data = np.concatenate([own, -1.0 / counts[rows]])
    index = (
        np.concatenate([np.arange(total), rows]),
        np.concatenate([np.arange(total), near[rows, places]]),
    )
    return csr_array((data, index), shape=(total, total))


class _Product(torch.autograd.Function):
    """Sparse times dense; torch's own gradient would build the transpose at every step."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, matrix: Tensor, transposed: Tensor) -> Tensor:
        ctx.save_for_backward(transposed)
        return matrix @ values

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (transposed,) = ctx.saved_tensors
        return transposed @ gradient, None, None


def attribute_roughness(
    laplacian: SurfaceLaplacian, raw: RawAttributes, scales: float, colors: float
) -> Tensor:
    """Weighted roughness of the raw log scales and of the sigmoid of the raw colours."""
    parts = math.sqrt(scales) * raw.log_scales, math.sqrt(colors) * raw.logit_colors.sigmoid()
    return laplacian.roughness(torch.cat(parts, dim=-1))


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
    """Mean penalty, over Gaussians and frames, of shapes that leave gaps in the surface.

    Args:
        raw: (B, N, k) attributes.
        spacing: mean distance between neighbouring anchors, m.
    """
    drawn = activation(raw)
    rows = _rotation_rows(drawn.quats)
    squares = (drawn.scales / spacing).square()
    xx, yy, xy = ((squares * rows[i] * rows[j]).sum(dim=-1) for i, j in ((0, 0), (1, 1), (0, 1)))
    across = xx + yy
    along = (squares * rows[2].square()).sum(dim=-1).clamp(min=_TINY)
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


def _rotation_rows(quats: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The rows (..., 3) of a unit quaternion's rotation, of which two lie in the skin."""
    w, x, y, z = quats.unbind(-1)
    first = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y))
    second = (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x))
    third = (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))
    return stack(first, dim=-1), stack(second, dim=-1), stack(third, dim=-1)
