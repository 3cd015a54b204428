"""`rasterize`: checks the call, picks the backend, gives the result its shape."""

from __future__ import annotations

from typing import Any

import torch

from hwp_bench.errors import MissingDependency, UsageError
from wildghand.splat.layout import check_options, flatten
from wildghand.splat.scene import Options, unflattened

#: What `backend` may be.
BACKENDS = ("auto", "numba", "gsplat", "reference")


def rasterize(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    *,
    backgrounds: torch.Tensor | None = None,
    backend: str = "auto",
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    count_pairs: bool = False,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Draws Gaussians into a batch of cameras (first version; see the module page)."""
    options = Options(
        width=width,
        height=height,
        near_plane=near_plane,
        far_plane=far_plane,
        eps2d=eps2d,
        render_mode=render_mode,
        antialiased=rasterize_mode == "antialiased",
        count_pairs=count_pairs,
    )
    check_options(options, rasterize_mode)
    tensors = {
        "means": means, "quats": quats, "scales": scales, "opacities": opacities,
        "colors": colors, "viewmats": viewmats, "Ks": Ks,
    }  # fmt: skip
    if backend not in BACKENDS:
        raise UsageError(
            f"is {backend!r}", field="backend", remedy=f"Use one of {', '.join(BACKENDS)}"
        )
    if backend == "auto":
        backend = "gsplat" if means.is_cuda else "numba"
    if backend == "gsplat":
        raise MissingDependency("gsplat backend not there yet", field="backend")
    if backend == "reference":
        from wildghand.splat.reference import rasterize_reference

        scene = flatten(tensors, backgrounds, options)
        channels, alphas, info = rasterize_reference(scene)
    else:
        from wildghand.splat.numba_backend import rasterize_numba

        tensors = {name: value.float() for name, value in tensors.items()}
        backgrounds = None if backgrounds is None else backgrounds.float()
        scene = flatten(tensors, backgrounds, options)
        channels, alphas, info = rasterize_numba(scene)
    return unflattened(channels, scene), unflattened(alphas, scene), info
