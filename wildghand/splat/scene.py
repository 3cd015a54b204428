"""The input of a backend: the tensors of one call, checked and brought to flat shapes."""

from __future__ import annotations

from dataclasses import dataclass

import torch


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


def channel_count(scene: FlatScene) -> int:
    """How many channels are blended in the scene's render mode."""
    mode = scene.options.render_mode
    return scene.colors.shape[-1] * ("RGB" in mode) + (mode != "RGB")


def channels_with_depth(
    colors: torch.Tensor, depths: torch.Tensor, scene: FlatScene
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """The channels to blend and their backgrounds, for the scene's render mode.

    Depth is one more channel, the last, over a background of 0, as in gsplat.

    Args:
        colors: (S, N, D).
        depths: (I, N) camera-space z in world units.
        scene: for the mode and the backgrounds.
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
    """Divides the accumulated depth, the last channel, by alpha in the modes that ask for it.

    Args:
        channels: (I, H, W, X).
        alphas: (I, H, W, 1).
        mode: one of `conventions.RENDER_MODES`.
    """
    if mode not in ("ED", "RGB+ED"):
        return channels
    depth = channels[..., -1:] / alphas.clamp(min=1e-10)
    return torch.cat((channels[..., :-1], depth), dim=-1)
