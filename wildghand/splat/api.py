"""`rasterize`: checks the call, picks the backend, gives the result its shape."""

from __future__ import annotations

import math
import operator
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

from hwp_bench.base.errors import UsageError
from wildghand.splat.scene import (
    FlatScene,
    Options,
    check_options,
    flatten,
    good_backgrounds,
    unflattened,
)

#: Values of `backend`.
BACKENDS = ("auto", "numba", "gsplat", "reference")

_Result = tuple[torch.Tensor, torch.Tensor, dict[str, Any]]


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
) -> _Result:
    """Draws 3D Gaussians into a batch of cameras (3D Gaussian splatting), differentiably.

    The arguments are those of `gsplat.rasterization`. Gradients flow to `means`, `quats`,
    `scales`, `opacities`, `colors`, `backgrounds` and `viewmats`; as in gsplat, not to `Ks`.

    Leading dimensions `...` are sets of Gaussians, each with C cameras. Besides gsplat's shapes,
    `viewmats` (C, 4, 4) with `means` (C, N, 3) pairs each camera with Gaussians of its own, and
    `quats`, `scales`, `opacities` and `colors` may leave `...` out: all sets share them.

    What is culled, and what a camera shows that cannot see, is in `docs/splatting.md`.

    Args:
        means: (..., N, 3) centres in world units.
        quats: (..., N, 4) rotations (w, x, y, z), of any norm but 0.
        scales: (..., N, 3) standard deviations in world units.
        opacities: (..., N) in [0, 1].
        colors: (..., N, D) or (..., C, N, D), any number D of channels of any kind.
        viewmats: (..., C, 4, 4) world to camera, OpenCV axes (x right, y down, z forward).
        Ks: (..., C, 3, 3) intrinsics in pixels; the first pixel's centre is at (0.5, 0.5). Only
            focal lengths and principal point are read.
        width: of the images, in pixels.
        height: of the images, in pixels.
        backgrounds: (..., C, D) or (D,); black if left out.
        backend: "numba" (CPU, float32), "gsplat" (CUDA, float32), "reference" (plain PyTorch, any
            device, float32 or float64, brute force: for tests), or "auto": gsplat for CUDA
            tensors, else numba. Half precision is computed and returned in float32 by every
            backend, float64 by the float32 backends too; gradients have the type of the argument.
        near_plane: nearest depth that is drawn, world units.
        far_plane: farthest depth that is drawn, world units.
        eps2d: low-pass filter: added to the variance on the image plane, px^2.
        render_mode: "RGB" for the colours; "D" for depth, summed with the weights of the
            colours, "ED" for its mean; "RGB+D" and "RGB+ED" with the depth as the last channel.
        rasterize_mode: "classic", or "antialiased": opacities lowered by what the filter adds to
            the area of a splat (Yu et al. 2024).
        count_pairs: whether to count the blended pairs (not with gsplat).

    Returns:
        colors (..., C, H, W, X), alphas (..., C, H, W, 1), and a dictionary with
            `means2d` (..., C, N, 2): centres in pixels, 0 if culled; a tensor on the way to the
                image, so `retain_grad()` on it gives what densification needs;
            `depths` (..., C, N): camera-space z, 0 if culled;
            `radii` (..., C, N, 2): int32, half the size of the visible part in pixels, 0 if
                culled;
            `visible` (..., C): how many Gaussians were not culled;
            `margin` (..., C, H, W), reference only: how near a pixel comes to one of the limits in
                `conventions`, as the least |log ratio|; float32 may decide otherwise below 1e-5;
            `pairs` (..., C): blended (Gaussian, pixel) pairs, if counted;
            `width`, `height`, `n_cameras`, `n_batches`, `backend`, and, as gsplat's strategies
            look for them, `camera_ids` and `gaussian_ids`: None.

    Raises:
        ShapeMismatch: a tensor does not fit the others.
        UsageError: no such backend or mode, or a tensor of the wrong kind or on the wrong device.
        MissingDependency: gsplat is asked for and not installed.

    Source: Kerbl et al. 2023; conventions of gsplat (see `conventions`).

    Example:
        >>> import torch
        >>> from wildghand.splat import rasterize
        >>> colors, alphas, info = rasterize(
        ...     means=torch.tensor([[0.0, 0.0, 2.0]]), quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        ...     scales=torch.full((1, 3), 0.1), opacities=torch.tensor([0.9]),
        ...     colors=torch.ones(1, 3), viewmats=torch.eye(4)[None],
        ...     Ks=torch.tensor([[[50.0, 0, 16], [0, 50, 16], [0, 0, 1]]]), width=32, height=32,
        ... )
        >>> tuple(colors.shape), tuple(alphas.shape)
        ((1, 32, 32, 3), (1, 32, 32, 1))
    """
    options = Options(
        width=_as_int(width),
        height=_as_int(height),
        near_plane=float(near_plane),
        far_plane=float(far_plane),
        eps2d=float(eps2d),
        render_mode=render_mode,
        antialiased=rasterize_mode == "antialiased",
        count_pairs=bool(count_pairs),
    )
    check_options(options, rasterize_mode)
    scene = flatten(
        {
            "means": means,
            "quats": quats,
            "scales": scales,
            "opacities": opacities,
            "colors": colors,
            "viewmats": viewmats,
            "Ks": Ks,
        },
        backgrounds,
        options,
    )
    name, draw = _backend(backend, means.device)
    scene = _usable_views(_one_dtype(scene, name))
    channels, alphas, info = draw(scene)
    info.update(
        width=options.width,
        height=options.height,
        n_cameras=scene.image_dims[-1],
        n_batches=scene.images // max(1, scene.image_dims[-1]),
        backend=name,
        camera_ids=None,
        gaussian_ids=None,
    )
    return unflattened(channels, scene), unflattened(alphas, scene), info


def _as_int(number: Any) -> Any:
    """An int from any integer type, such as numpy's; anything else is returned as it is."""
    try:
        return operator.index(number)
    except TypeError:
        return number


def _backend(name: str, device: torch.device) -> tuple[str, Callable[[FlatScene], _Result]]:
    """The backend's name and function; imported only now, with its own dependencies."""
    if name not in BACKENDS:
        raise UsageError(
            f"is {name!r}", field="backend", remedy=f"Use one of {', '.join(BACKENDS)}"
        )
    if name == "auto":
        name = "gsplat" if device.type == "cuda" else "numba"
    if name == "reference":
        from wildghand.splat.reference import rasterize_reference

        return name, rasterize_reference
    needed = "cuda" if name == "gsplat" else "cpu"
    if device.type != needed:
        raise UsageError(
            f"{name} draws on {needed}, and the tensors are on {device}",
            field="backend",
            remedy=f"Move them to {needed}, or use another backend",
        )
    if name == "gsplat":
        from wildghand.splat.gsplat_backend import rasterize_gsplat

        return name, rasterize_gsplat
    from wildghand.splat.numba_backend import rasterize_numba

    return name, rasterize_numba


def _one_dtype(scene: FlatScene, backend: str) -> FlatScene:
    """The scene in the dtype that the backend computes in."""
    tensors = {name: value for name, value in vars(scene).items() if torch.is_tensor(value)}
    dtype = torch.float32
    if backend == "reference":
        for tensor in tensors.values():
            dtype = torch.promote_types(dtype, tensor.dtype)
    converted: dict[str, Any] = {name: tensor.to(dtype) for name, tensor in tensors.items()}
    return replace(scene, **converted)


def _usable_views(scene: FlatScene) -> FlatScene:
    """Warns of cameras that see nothing; makes backgrounds that are not finite black."""
    if scene.means.is_cuda:  # backends do the latter, without another copy to the host
        return scene
    finite = math.isfinite(scene.viewmats.detach().sum() + scene.Ks.detach().sum())
    if not finite and not (scene.viewmats.isfinite().all() and scene.Ks.isfinite().all()):
        warnings.warn("rasterize: a camera is not finite; its image shows only the background")
    elif not scene.Ks.detach()[:, (0, 1), (0, 1)].amin() > 0:
        warnings.warn("rasterize: a camera has no positive focal length; it sees nothing")
    if scene.backgrounds is None:
        return scene
    good = good_backgrounds(scene.backgrounds)
    if good.all():
        return scene
    warnings.warn("rasterize: a background is not finite or beyond MAX_COLOR; drawn black")
    return replace(scene, backgrounds=torch.where(good, scene.backgrounds, 0.0))
