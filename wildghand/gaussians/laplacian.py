"""Roughness of values spread over the hand's surface: a sparse Laplacian, made once."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.errors import ShapeMismatch
from hwp_bench.base.numerics import kd_tree
from hwp_bench.hands.anchors import anchor_frames, anchor_positions
from wildghand.gaussians.bags import sum_bags
from wildghand.gaussians.rig import HandRig
from wildghand.splat.threads import kernels_take

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
        """Differences to the neighbours' mean.

        Args:
            values: (..., N, C).

        Returns:
            (..., N, C) in the matrix's type.

        Raises:
            ShapeMismatch: not N rows.
        """
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
        """Roughness of displacements.

        Displacements are compared in the axes of the rest pose and in units of the spacing:
        the tangents of neighbouring anchor frames may point anywhere.

        Args:
            offsets: (..., N, 3) m, in the anchors' frames.
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
    """Nearest points whose normals differ by less than a right angle.

    Args:
        positions: (N, 3).
        normals: (N, 3) of length 1.
        count: neighbours to find.

    Returns:
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
        return sparse_times(matrix, values)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (transposed,) = ctx.saved_tensors
        return sparse_times(transposed, gradient), None, None


def sparse_times(matrix: Tensor, rows: Tensor) -> Tensor:
    """Product of a matrix of a `SurfaceLaplacian` and rows.

    Args:
        matrix: (N, N) sparse CSR.
        rows: (N, C) of the same type; no gradient is recorded on the CPU.
    """
    if kernels_take(rows):
        starts = matrix.crow_indices()[:-1]
        return sum_bags(rows, matrix.col_indices(), matrix.values(), starts)
    return matrix @ rows
