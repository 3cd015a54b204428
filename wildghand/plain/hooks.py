"""The hooks of a fit: what the loop asks of a recipe, and what it gives to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch

from hwp_bench.methods.contract import Avatar, TrainingCapture
from wildghand.gaussians.losses import photometric_loss
from wildghand.gaussians.training import TrainingFrames, soft_weights
from wildghand.plain.settings import LoopSettings

Settings = TypeVar("Settings", bound=LoopSettings)


@dataclass(frozen=True, eq=False)
class Material:
    """The material of a fit."""

    #: What the method may see of the capture.
    training: TrainingCapture
    #: The frames to fit.
    frames: TrainingFrames
    #: Of everything random.
    seed: int
    #: Where the tensors live.
    device: torch.device


@dataclass(frozen=True, eq=False)
class Batch:
    """The B frames of one step."""

    #: Steps before this one.
    step: int
    #: Share of the budget that is used up, in [0, 1).
    fraction: float
    #: (B,) int64 on the CPU, positions in `TrainingFrames.indices`.
    rows: torch.Tensor
    #: (B, H, W, 3) sRGB in [0, 1], black outside the mask: what drawings are compared with.
    images: torch.Tensor
    #: (B, H, W) estimated coverage of the visible hand, in [0, 1].
    masks: torch.Tensor


@dataclass(frozen=True, eq=False)
class Drawing:
    """A batch as a method draws it."""

    #: (B, H, W, 3) sRGB over black.
    image: torch.Tensor
    #: (B, H, W, 1) coverage in [0, 1].
    coverage: torch.Tensor


class Recipe(Generic[Settings]):
    """A fit with its hooks. The plain fit is one; a method with a model of its own is another.

    The loop calls, in each step, `draw`, `weights`, `loss` and, after Adam's step, `after_step`.
    Hooks keep what they need as attributes; tensors that Adam fits are named by `parameters`.

    Args:
        material: what is fitted.
        settings: how.
    """

    def __init__(self, material: Material, settings: Settings) -> None:
        self.material = material
        self.settings = settings

    def parameters(self) -> dict[str, torch.Tensor]:
        """The tensors that Adam fits, by name, in a fixed order."""
        raise NotImplementedError

    def rates(self) -> dict[str, float]:
        """Adam's step at the start of each tensor, by name."""
        raise NotImplementedError

    def draw(self, batch: Batch) -> Drawing:
        """Draw the frames of a batch; differentiable. The formation of an image is in here."""
        raise NotImplementedError

    def avatar(self, steps: int) -> Avatar:
        """The avatar that draws test frames; while the fit goes on it may share live tensors."""
        raise NotImplementedError

    def rate(self, name: str, fraction: float) -> float:
        """Adam's step of a tensor after a share of the budget; it falls geometrically.

        Args:
            name: of the tensor.
            fraction: in [0, 1).
        """
        return self.rates()[name] * self.settings.final_rate**fraction

    def weights(self, batch: Batch, drawing: Drawing) -> torch.Tensor:
        """Weights of the pixels in the loss, (B, H, W), not negative.

        The plain fit has 1 where the mask shows the hand and `outside_weight` elsewhere.
        """
        return soft_weights(batch.masks, self.settings.outside_weight)

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """The scalar that Adam makes small."""
        return photometric_loss(drawing.image, batch.images, weights, self.settings.dssim_weight)

    def after_step(self, batch: Batch) -> None:
        """Called after Adam's step; keeps the tensors within their ranges."""

    def finite(self) -> bool:
        """Whether every fitted number is finite."""
        return all(bool(value.isfinite().all()) for value in self.parameters().values())

    def snapshot(self) -> dict[str, torch.Tensor]:
        """Copies of the fitted tensors, which the fit no longer changes."""
        return {name: value.detach().clone() for name, value in self.parameters().items()}

    @torch.no_grad()
    def restore(self, values: Mapping[str, torch.Tensor]) -> None:
        """Go back to a `snapshot`."""
        for name, value in self.parameters().items():
            value.copy_(values[name])
