"""Checks the arguments of `rasterize` and brings them to the flat shapes of a `FlatScene`."""

from __future__ import annotations

import math

import torch

from hwp_bench.base.errors import ShapeMismatch, UsageError
from wildghand.splat.conventions import RASTERIZE_MODES, RENDER_MODES
from wildghand.splat.scene import FlatScene, Options


def flatten(
    tensors: dict[str, torch.Tensor],
    backgrounds: torch.Tensor | None,
    options: Options,
) -> FlatScene:
    """One `FlatScene` from the arguments as the caller gave them.

    Args:
        tensors: `means`, `quats`, `scales`, `opacities`, `colors`, `viewmats`, `Ks`.
        backgrounds: (..., C, D) or (D,) or None.
        options: already checked.

    Raises:
        ShapeMismatch: a tensor does not fit the others; names it.
        UsageError: not a floating-point tensor, or on another device than `means`.
    """
    given = dict(tensors) if backgrounds is None else {**tensors, "backgrounds": backgrounds}
    _check_kind(given)
    means, viewmats = tensors["means"], tensors["viewmats"]
    _require(means.ndim >= 2 and means.shape[-1] == 3, "means", means, "(..., N, 3)")
    _require(
        viewmats.ndim >= 3 and viewmats.shape[-2:] == (4, 4), "viewmats", viewmats, "(..., C, 4, 4)"
    )
    batch, count = tuple(means.shape[:-2]), means.shape[-2]
    paired = viewmats.ndim == 3 and len(batch) == 1
    if paired:
        expected: tuple[int, ...] = (*batch, 4, 4)
        image_dims = batch
        cameras = 1
    else:
        cameras = viewmats.shape[-3]
        expected = (*batch, cameras, 4, 4)
        image_dims = (*batch, cameras)
    _require(tuple(viewmats.shape) == expected, "viewmats", viewmats, _show(expected))
    _require(math.prod(image_dims) >= 1, "viewmats", viewmats, "at least one camera")
    Ks = tensors["Ks"]
    _require(tuple(Ks.shape) == (*expected[:-2], 3, 3), "Ks", Ks, _show((*expected[:-2], 3, 3)))
    groups = math.prod(batch)
    images = groups * cameras

    flat: dict[str, torch.Tensor] = {"means": means.reshape(groups, count, 3)}
    for name, tail in (("quats", (count, 4)), ("scales", (count, 3)), ("opacities", (count,))):
        tensor = tensors[name]
        shape = tuple(tensor.shape)
        shared = shape == tail
        _require(shared or shape == (*batch, *tail), name, tensor, _show((*batch, *tail)))
        flat[name] = tensor.reshape(1 if shared else groups, *tail)
    flat["colors"] = _flat_colors(tensors["colors"], batch, cameras, count)
    channels = flat["colors"].shape[-1]
    flat_backgrounds = None
    if backgrounds is not None:
        shape = tuple(backgrounds.shape)
        full = (*image_dims, channels)
        _require(
            shape in (full, (channels,)),
            "backgrounds",
            backgrounds,
            f"{_show(full)} or ({channels},)",
        )
        flat_backgrounds = backgrounds.expand(full).reshape(images, channels)
    return FlatScene(
        **flat,
        viewmats=viewmats.reshape(images, 4, 4),
        Ks=Ks.reshape(images, 3, 3),
        backgrounds=flat_backgrounds,
        options=options,
        image_dims=image_dims,
    )


def check_options(options: Options, rasterize_mode: str) -> None:
    """Refuses settings that make no sense.

    Raises:
        UsageError: names the argument and says which values it may have.
    """
    for name, choices, value in (
        ("render_mode", RENDER_MODES, options.render_mode),
        ("rasterize_mode", RASTERIZE_MODES, rasterize_mode),
    ):
        if value not in choices:
            raise UsageError(f"is {value!r}", field=name, remedy=f"Use one of {', '.join(choices)}")
    for name, size in (("width", options.width), ("height", options.height)):
        if not isinstance(size, int) or not 1 <= size <= 32768:
            raise UsageError(
                f"is {size!r}", field=name, remedy="Use an integer number of pixels, 1 to 32768"
            )
    if not 0.0 <= options.near_plane < options.far_plane:
        raise UsageError(
            f"is {options.near_plane!r}, the far plane {options.far_plane!r}",
            field="near_plane",
            remedy="Planes must satisfy 0 <= near_plane < far_plane",
        )
    if not 0.0 <= options.eps2d < math.inf:
        raise UsageError(
            f"is {options.eps2d!r}", field="eps2d", remedy="Use a finite value >= 0 (px^2)"
        )


def _flat_colors(
    colors: torch.Tensor, batch: tuple[int, ...], cameras: int, count: int
) -> torch.Tensor:
    """(..., N, D) or (..., C, N, D) or (N, D) to (S, N, D)."""
    shapes = {(count,): 1, (*batch, count): math.prod(batch)}
    shapes[(*batch, cameras, count)] = math.prod(batch) * cameras
    lead = tuple(colors.shape[:-1])
    _require(
        colors.ndim >= 2 and colors.shape[-1] >= 1 and lead in shapes,
        "colors",
        colors,
        f"{_show((*batch, count, 'D'))} or {_show((*batch, cameras, count, 'D'))} with D >= 1",
    )
    return colors.reshape(shapes[lead], count, colors.shape[-1])


def _check_kind(tensors: dict[str, torch.Tensor]) -> None:
    for name, tensor in tensors.items():
        if not isinstance(tensor, torch.Tensor) or not tensor.is_floating_point():
            kind = tensor.dtype if isinstance(tensor, torch.Tensor) else type(tensor).__name__
            raise UsageError(f"is {kind}", field=name, remedy="Pass a floating-point torch.Tensor")
        if tensor.device != tensors["means"].device:
            raise UsageError(
                f"is on {tensor.device}, means on {tensors['means'].device}",
                field=name,
                remedy="Put every tensor of the call on one device",
            )


def _require(holds: bool, name: str, tensor: torch.Tensor, expected: str) -> None:
    if not holds:
        raise ShapeMismatch(
            f"has shape {_show(tuple(tensor.shape))}", field=name, remedy=f"It must be {expected}"
        )


def _show(shape: tuple[object, ...]) -> str:
    return "(" + ", ".join(str(size) for size in shape) + ("," if len(shape) == 1 else "") + ")"
