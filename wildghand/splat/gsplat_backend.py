"""CUDA backend: gsplat's kernels, behind the same signature and with the same checks.

gsplat computes in float32 throughout and does not look for values that are not finite: one NaN
quaternion makes every gradient NaN. So offenders are replaced by Gaussians that draw nothing and
get no gradient; all others go to gsplat as they are. This happens on the device: nobody waits to
learn whether there are any, unless cameras share Gaussians but not their colours. gsplat itself
reads one number back, how many tiles its splats cover.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from typing import Any

import torch

from hwp_bench.base.errors import MissingDependency
from wildghand.splat.reference import rasterize_reference
from wildghand.splat.scene import FlatScene, good_backgrounds, largest, usable

#: Beyond this, squares of lengths leave float32 inside gsplat.
_MAX_LENGTH = 1e15
#: A quaternion's largest number; the gradient of one outside leaves float32.
_TURNS = (1e-36, 1e36)
#: gsplat divides by the depth of all that is not nearer than the near plane.
_LEAST_NEAR_PLANE = 1e-6
#: gsplat takes leading batch dimensions from this version on.
_LEAST_VERSION = (1, 5, 2)


def rasterize_gsplat(scene: FlatScene) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Draws the scene, float32 on a CUDA device; see `wildghand.splat.rasterize`.

    Returns:
        channels (I, H, W, X), alphas (I, H, W, 1) and the backend's part of `info`.

    Raises:
        MissingDependency: gsplat is not installed, or cannot load its kernels.

    Source: gsplat, `gsplat.rasterization` (Ye et al. 2024), version 1.5.2 or later.
    """
    rasterization = _gsplat()
    if not scene.gaussians:  # gsplat's kernels cannot be started
        return rasterize_reference(scene)
    tensors = _harmless(scene)
    groups = max(tensors[name].shape[0] for name in ("means", "quats", "scales", "opacities"))
    options = scene.options
    channels, alphas, meta = rasterization(
        **(_single(tensors) if groups <= 1 else _batch(tensors, groups)),
        width=options.width,
        height=options.height,
        near_plane=max(options.near_plane, _LEAST_NEAR_PLANE),
        far_plane=options.far_plane,
        eps2d=options.eps2d,
        packed=False,  # packing pays where cameras see little of a scene; they see whole hands
        render_mode=options.render_mode,
        rasterize_mode="antialiased" if options.antialiased else "classic",
    )
    return channels.flatten(0, -4), alphas.flatten(0, -4), _info(scene, meta)


def _info(scene: FlatScene, meta: dict[str, Any]) -> dict[str, Any]:
    count = scene.gaussians
    info = {}
    for name, tail in (("means2d", (count, 2)), ("depths", (count,)), ("radii", (count, 2))):
        value = meta[name]
        # Where the shape is right already, this must be the very tensor whose gradient gsplat
        # makes, not a view of it.
        shape = (*scene.image_dims, *tail)
        info[name] = value if tuple(value.shape) == shape else value.reshape(shape)
    shown = (info["radii"] > 0).all(-1)
    info["visible"] = shown.sum(-1)
    # gsplat writes neither place nor depth of what is culled, and reads neither in its backward
    # pass; past autograd, so that the tensor stays the one whose gradient it makes.
    info["means2d"].data.masked_fill_(~shown[..., None], 0.0)
    info["depths"] = info["depths"].masked_fill(~shown, 0.0)
    return info


def _gsplat() -> Callable[..., Any]:
    """gsplat's function."""
    try:
        import gsplat
    except (ImportError, OSError) as error:
        raise MissingDependency(
            f"the CUDA backend needs gsplat, which cannot be imported ({error})",
            field="backend",
            remedy="Install it with `pip install gsplat`, or pass CPU tensors",
        ) from error
    if tuple(int(part) for part in re.findall(r"\d+", gsplat.__version__)[:3]) < _LEAST_VERSION:
        raise MissingDependency(
            f"gsplat is {gsplat.__version__}, and the CUDA backend needs 1.5.2 or later",
            field="backend",
            remedy="Update it with `pip install -U gsplat`, or pass CPU tensors",
        )
    rasterization: Callable[..., Any] = gsplat.rasterization
    return rasterization


def _harmless(scene: FlatScene) -> dict[str, torch.Tensor]:
    """The scene's tensors, with everything that gsplat cannot take made invisible."""
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
    result = {name: getattr(scene, name) for name in names}
    good, cameras = usable(scene, _MAX_LENGTH, _TURNS)
    # The squares of a quaternion must stay in float32.
    longest = torch.where(good["quats"], largest(scene.quats), 1.0)
    result["quats"] = scene.quats / longest[..., None]
    neutral = _neutral(scene.means.device, scene.means.dtype)
    zero = neutral["zero"]
    for name, mask in good.items():
        result[name] = _replaced(result[name], mask, neutral.get(name, zero))
    # An offender in any argument makes the Gaussian vanish: its opacity is zero.
    opacities = result["opacities"]
    colors = good.pop("colors")
    finest = max(mask.shape[0] for mask in good.values())
    # Where each camera has colours of its own, this would take the Gaussians apart that cameras
    # share. Only then somebody looks whether it must be.
    if colors.shape[0] <= finest or not bool(colors.all()):
        good["colors"] = colors
        finest = max(finest, colors.shape[0])
    visible = torch.ones(finest, scene.gaussians, dtype=torch.bool, device=opacities.device)
    for mask in good.values():
        visible = visible & _repeat(mask, finest)
    result["opacities"] = torch.where(visible, _repeat(opacities, finest), zero)
    if scene.backgrounds is not None:
        fine = good_backgrounds(scene.backgrounds)
        result["backgrounds"] = torch.where(fine, scene.backgrounds, zero)
    for name in ("viewmats", "Ks"):
        result[name] = _replaced(result[name], cameras, neutral[name])
    return result


def _replaced(tensor: torch.Tensor, good: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
    return torch.where(good.reshape(good.shape + (1,) * (tensor.ndim - good.ndim)), tensor, value)


@functools.lru_cache(maxsize=8)
def _neutral(device: torch.device, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    """What stands in for rows that gsplat cannot take, a camera's sees nothing; by argument.

    Made once for a device: each of these would start a kernel in every call.
    """
    away = torch.zeros(4, 4, dtype=dtype)
    away[2, 3], away[3, 3] = -1.0, 1.0
    made = {
        "zero": torch.zeros((), dtype=dtype),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=dtype),
        "viewmats": away,
        "Ks": torch.eye(3, dtype=dtype),
    }
    return {name: tensor.to(device) for name, tensor in made.items()}


def _repeat(tensor: torch.Tensor, count: int) -> torch.Tensor:
    return tensor.repeat_interleave(count // tensor.shape[0], dim=0)


def _single(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Arguments for cameras that all see the same Gaussians; colours may differ."""
    flat = {name: tensors[name][0] for name in ("means", "quats", "scales", "opacities")}
    colors = tensors["colors"]
    flat["colors"] = colors[0] if colors.shape[0] == 1 else colors
    return {**tensors, **flat}


def _batch(tensors: dict[str, torch.Tensor], groups: int) -> dict[str, torch.Tensor]:
    """Arguments with a leading dimension of sets of Gaussians."""
    cameras = tensors["viewmats"].shape[0] // groups
    result = {}
    for name, tensor in tensors.items():
        if name in ("viewmats", "Ks", "backgrounds") or (
            name == "colors" and tensor.shape[0] > groups
        ):
            result[name] = tensor.reshape(groups, cameras, *tensor.shape[1:])
        else:
            result[name] = tensor.expand(groups, *tensor.shape[1:])
    return result
