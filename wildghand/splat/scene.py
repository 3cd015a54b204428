"""The input of a backend: the tensors of one call, checked and brought to flat shapes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from hwp_bench.base.errors import ShapeMismatch, UsageError
from wildghand.splat.conventions import MAX_COLOR, RASTERIZE_MODES, RENDER_MODES


@dataclass(frozen=True)
class Options:
    """How to draw; the same for every image of a call."""

    #: Image width in pixels.
    width: int
    #: Image height in pixels.
    height: int
    #: Gaussians whose centre is not farther than this from the camera plane are culled.
    near_plane: float
    #: Gaussians whose centre is not nearer than this are culled.
    far_plane: float
    #: Low-pass filter, px^2, added to the diagonal of the projected covariance.
    eps2d: float
    #: One of `conventions.RENDER_MODES`.
    render_mode: str
    #: Whether the opacity is lowered by what the low-pass filter adds to the area
    #: (gsplat's `rasterize_mode="antialiased"`).
    antialiased: bool
    #: Whether to count the blended (Gaussian, pixel) pairs.
    count_pairs: bool


@dataclass(frozen=True)
class FlatScene:
    """I images of N Gaussians each.

    A tensor whose leading size S is smaller than I is shared: image i reads its entry
    `i // (I // S)`. So nothing is copied for a batch of cameras that look at the same
    Gaussians, and the gradient is summed where it is made.
    """

    means: torch.Tensor  # (S, N, 3)
    quats: torch.Tensor  # (S, N, 4)
    scales: torch.Tensor  # (S, N, 3)
    opacities: torch.Tensor  # (S, N)
    colors: torch.Tensor  # (S, N, D); D = 0 where only depth is drawn
    viewmats: torch.Tensor  # (I, 4, 4)
    Ks: torch.Tensor  # (I, 3, 3)
    backgrounds: torch.Tensor | None  # (I, D)
    options: Options
    image_dims: tuple[int, ...]  # the caller's leading shape of an image; its product is I

    @property
    def images(self) -> int:
        """How many images are drawn."""
        return self.viewmats.shape[0]

    @property
    def gaussians(self) -> int:
        """How many Gaussians each image has, culled ones included."""
        return self.means.shape[1]


def unflattened(tensor: torch.Tensor, scene: FlatScene) -> torch.Tensor:
    """(I, ...) to (*image_dims, ...)."""
    return tensor.reshape(scene.image_dims + tuple(tensor.shape[1:]))


def per_image(tensor: torch.Tensor, images: int) -> torch.Tensor:
    """A view of a shared (S, ...) tensor with one entry per image, (I, ...)."""
    share = tensor.shape[0]
    if share == images:
        return tensor
    repeat = images // share if share else 0
    return tensor.unsqueeze(1).expand(share, repeat, *tensor.shape[1:]).flatten(0, 1)


def largest(tensor: torch.Tensor) -> torch.Tensor:
    """The largest absolute number of each row; NaN where one is NaN."""
    return torch.linalg.vector_norm(tensor.detach(), ord=torch.inf, dim=-1)


def usable(
    scene: FlatScene, most: float, turns: tuple[float, float]
) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Find what can be drawn: (S, N) masks of each argument's Gaussians, and (I,) of the cameras.

    `most` is the largest length; the largest number of a quaternion lies between `turns`, the first
    excluded. Colours stay within `MAX_COLOR`, focal lengths are positive, all is finite.
    """
    turn, focal = largest(scene.quats), scene.Ks.detach().diagonal(dim1=-2, dim2=-1)[:, :2]
    gaussians = {
        "means": largest(scene.means) <= most,
        "scales": largest(scene.scales) <= most,
        "quats": (turn > turns[0]) & (turn <= turns[1]),
        "colors": largest(scene.colors) <= MAX_COLOR,
        "opacities": scene.opacities.detach().isfinite(),
    }
    cameras = (focal > 0.0).all(1) & (largest(scene.Ks.flatten(1)) <= most)
    return gaussians, cameras & scene.viewmats.detach().flatten(1).isfinite().all(1)


def good_backgrounds(backgrounds: torch.Tensor) -> torch.Tensor:
    """Which numbers of backgrounds can be drawn; what stands in for others is black."""
    return backgrounds.detach().abs() <= MAX_COLOR


def channel_count(scene: FlatScene) -> int:
    """How many channels are blended in the scene's render mode."""
    mode = scene.options.render_mode
    return scene.colors.shape[-1] * ("RGB" in mode) + (mode != "RGB")


def channels_with_depth(
    colors: torch.Tensor, depths: torch.Tensor, scene: FlatScene
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """The channels to blend and their backgrounds, for the scene's render mode.

    Depth, (I, N), is one more channel, the last, over a background of 0, as in gsplat.
    """
    mode = scene.options.render_mode
    backgrounds = scene.backgrounds
    if mode == "RGB":
        return colors, backgrounds
    depth = depths.unsqueeze(-1)
    if mode in ("D", "ED"):
        return depth, None
    if backgrounds is not None:
        backgrounds = torch.cat((backgrounds, backgrounds.new_zeros(scene.images, 1)), dim=-1)
    return torch.cat((per_image(colors, scene.images), depth), dim=-1), backgrounds


def expected_depth(channels: torch.Tensor, alphas: torch.Tensor, mode: str) -> torch.Tensor:
    """Divides the accumulated depth, the last channel, by alpha in the modes that ask for it."""
    if mode not in ("ED", "RGB+ED"):
        return channels
    depth = channels[..., -1:] / alphas.clamp(min=1e-10)
    return torch.cat((channels[..., :-1], depth), dim=-1)


def flatten(
    tensors: dict[str, torch.Tensor],
    backgrounds: torch.Tensor | None,
    options: Options,
) -> FlatScene:
    """One `FlatScene` from the arguments as the caller gave them, by name; names a wrong one."""
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
    """Refuses settings that make no sense: names the argument and says which values it may have."""
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
