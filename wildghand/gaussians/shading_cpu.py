"""Spherical harmonics of many normals on the CPU: one pass in place of forty operations."""

from __future__ import annotations

from torch import Tensor

from wildghand.gaussians.row_kernels import PIECE
from wildghand.gaussians.row_kernels import fill_harmonics as kernel
from wildghand.splat.threads import run_pieces


def fill_harmonics(normals: Tensor, degree: int, out: Tensor, first: int) -> None:
    """`wildghand.gaussians.shading.sh_basis` without the constant, into columns of a tensor.

    Args:
        normals: (M, 3) float32 of length 1, on the CPU.
        degree: 1 to 3.
        out: (M, channels) float32; the columns from `first` on are filled.
        first: column.
    """
    run_pieces(
        kernel,
        len(normals),
        PIECE,
        len(normals),
        normals.detach().contiguous().numpy(),
        degree,
        out.numpy(),
        first,
    )
