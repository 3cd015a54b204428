"""Scenes at the limits of arithmetic, and the result of drawing one."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from wildghand.splat.api import rasterize

#: Arguments that have a gradient.
DIFFERENTIABLE = ("means", "quats", "scales", "opacities", "colors", "backgrounds", "viewmats")
#: Arguments with one row for each Gaussian.
PER_GAUSSIAN = DIFFERENTIABLE[:5]
#: A pixel that comes nearer than this to a limit (as a ratio) is not compared: float32 and
#: float64 may decide differently whether a splat that is just visible is drawn.
MARGIN = 1e-5

Arguments = dict[str, torch.Tensor]


@dataclass(frozen=True)
class HardScene:
    """The arguments of one call, float64."""

    arguments: Arguments
    width: int = 40
    height: int = 30
    near_plane: float = 0.01
    eps2d: float = 0.3

    def changed(self, **arguments: torch.Tensor) -> HardScene:
        """The same scene with other tensors."""
        return HardScene(
            {**self.arguments, **arguments}, self.width, self.height, self.near_plane, self.eps2d
        )

    def without(self, index: int) -> HardScene:
        """The same scene without one Gaussian."""
        keep = torch.arange(len(self.arguments["means"])) != index
        return self.changed(**{name: self.arguments[name][keep] for name in PER_GAUSSIAN})


@dataclass(frozen=True)
class DrawnScene:
    """The result of drawing a scene, in float64 on the CPU."""

    image: torch.Tensor  # (C, H, W, D)
    alpha: torch.Tensor  # (C, H, W, 1)
    gradients: Arguments  # of every differentiable argument

    @property
    def finite(self) -> bool:
        """Whether no number is NaN or infinite."""
        tensors = (self.image, self.alpha, *self.gradients.values())
        return all(bool(tensor.isfinite().all()) for tensor in tensors)


def hand_scene(
    count: int = 60,
    width: int = 40,
    height: int = 30,
    cameras: int = 1,
    distance: float = 0.4,
    focal: float = 60.0,
    seed: int = 0,
) -> HardScene:
    """A blob of the size of a hand (0.16 m), looked at by cameras side by side.

    Args:
        count: Gaussians.
        width, height: pixels.
        cameras: 1 cm apart.
        distance: of the blob from the cameras, metres.
        focal: length, px.
        seed: of everything random.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    viewmats = torch.eye(4, dtype=torch.float64).repeat(cameras, 1, 1)
    viewmats[:, 0, 3] = 0.01 * torch.arange(cameras)
    viewmats[:, 2, 3] = distance
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    arguments = {
        "means": (uniform(count, 3) - 0.5) * 0.16,
        "quats": torch.randn(count, 4, generator=generator, dtype=torch.float64),
        "scales": 0.004 + 0.012 * uniform(count, 3),
        "opacities": 0.2 + 0.75 * uniform(count),
        "colors": uniform(count, 3),
        "viewmats": viewmats,
        "Ks": K.double().repeat(cameras, 1, 1),
        "backgrounds": uniform(cameras, 3),
    }
    # Values that float32 cannot hold must not count against the backend.
    rounded = {name: tensor.float().double() for name, tensor in arguments.items()}
    return HardScene(rounded, width, height)


def draw(
    scene: HardScene, backend: str, dtype: torch.dtype, weights: torch.Tensor | None = None
) -> DrawnScene:
    """Draws a scene and takes the gradients of a fixed random linear loss.

    Args:
        scene: to draw.
        backend: as for `rasterize`.
        dtype: of the arguments.
        weights: (C, H, W), by which the loss of each pixel is multiplied.
    """
    device = torch.device("cuda" if backend == "gsplat" else "cpu")
    arguments = {
        name: tensor.detach().to(device, dtype).requires_grad_(name in DIFFERENTIABLE)
        for name, tensor in scene.arguments.items()
    }
    image, alpha, _ = _rasterize(scene, arguments, backend)
    loss = (_noise(image.shape, 1).to(image) * image).sum(-1)
    loss = loss + (_noise(alpha.shape, 2).to(alpha) * alpha).sum(-1)
    if weights is not None:
        loss = loss * weights.to(loss)
    loss.sum().backward()
    zero = torch.zeros(())
    gradients = {
        name: (zero.expand(tensor.shape) if tensor.grad is None else tensor.grad).cpu().double()
        for name, tensor in arguments.items()
        if name in DIFFERENTIABLE
    }
    return DrawnScene(image.detach().cpu().double(), alpha.detach().cpu().double(), gradients)


def clear_pixels(scene: HardScene) -> torch.Tensor:
    """1 for every pixel that may be compared, 0 for those within `MARGIN` of a limit. (C, H, W)."""
    with torch.no_grad():
        _, _, info = _rasterize(scene, scene.arguments, "reference")
    return (info["margin"] > MARGIN).double()


def _rasterize(
    scene: HardScene, arguments: Arguments, backend: str
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "rasterize: ")
        return rasterize(
            **arguments,  # type: ignore[arg-type]
            width=scene.width,
            height=scene.height,
            near_plane=scene.near_plane,
            eps2d=scene.eps2d,
            backend=backend,
        )


def difference(measured: torch.Tensor, truth: torch.Tensor) -> float:
    """Relative L2 distance; absolute where the truth is zero."""
    size = float(truth.norm())
    return float((measured - truth).norm()) / (size if size > 0 else 1.0)


def gradient_differences(
    measured: Mapping[str, torch.Tensor], truth: DrawnScene
) -> dict[str, float]:
    """`difference` of every gradient."""
    return {name: difference(measured[name], value) for name, value in truth.gradients.items()}


def _noise(shape: torch.Size, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64)
