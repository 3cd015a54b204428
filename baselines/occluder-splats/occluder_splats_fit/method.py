"""The plain fit behind occluders of each frame's own, in the manner of DeSplat."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from hwp_bench.methods.settings import choice, number
from occluder_splats_fit.occluders import make_occluders, mask_boxes
from wildghand.gaussians.losses import photometric_loss
from wildghand.gaussians.training import shares_of_255
from wildghand.plain.recipe import Batch, Drawing, FitSettings, Material, PlainRecipe, RecipeMethod


@dataclass(frozen=True)
class OccluderSettings(FitSettings):
    """The plain fit's settings, and those of the occluders."""

    #: Gaussians before the camera in each frame.
    occluders: int = number(150, 1, 10_000)
    #: `mask`: the frame inside the visible-hand mask, as in the plain fit. `box`: the whole frame
    #: in the mask's bounding box, as DeSplat has it, with weight 1 everywhere in it.
    target: str = choice("mask", "box")
    #: Opacity of every occluder at the start.
    occluder_opacity: float = number(0.1, 0.01, 0.99)
    #: Weight of the occluders' mean coverage in the loss.
    occluder_weight: float = number(0.1, 0.0, 10.0)
    #: Weight of the mean share of the mask that the hand does not cover.
    hole_weight: float = number(0.01, 0.0, 10.0)
    #: Adam step of the occluders' places, px.
    occluder_place_rate: float = 0.05
    #: Adam step of the occluders' log scales and angles.
    occluder_shape_rate: float = 0.02
    #: Adam step of the occluders' logit opacities.
    occluder_opacity_rate: float = 0.2
    #: Adam step of the occluders' logit colours.
    occluder_color_rate: float = 0.03


# Standard deviations of occluders stay within these, px: finer than a pixel, half a frame.
_SIGMAS = (0.3, 64.0)


@dataclass(frozen=True, eq=False)
class OccludedDrawing(Drawing):
    """A batch with the occluders before the hand; `coverage` is the hand's."""

    #: (B, H, W, 1) coverage of the occluders in [0, 1].
    occluded: torch.Tensor


class OccluderRecipe(PlainRecipe[OccluderSettings]):
    """image = C_occluders + (1 - alpha_occluders) C_hand."""

    def __init__(self, material: Material, settings: OccluderSettings) -> None:
        super().__init__(material, settings)
        frames = material.frames
        self.boxes = mask_boxes(frames.masks)
        inside = frames.images
        if settings.target == "mask":  # what the occluders are compared with is black outside
            shares = frames.masks[..., None].float() / 255.0
            inside = (inside.float() * shares).round().to(torch.uint8)
        self.occluders = make_occluders(
            inside, self.boxes, settings.occluders, settings.occluder_opacity, material.device
        )

    def parameters(self) -> dict[str, torch.Tensor]:
        """The plain fit's, and the occluders'."""
        return {**super().parameters(), **self.occluders.parameters()}

    def draw(self, batch: Batch) -> OccludedDrawing:
        """The occluders of the frames before the hand."""
        hand = super().draw(batch)
        training = self.material.training
        image, occluded = self.occluders.render(
            batch.rows, self.clip.Ks[batch.rows], training.width, training.height
        )
        return OccludedDrawing(image + (1.0 - occluded) * hand.image, hand.coverage, occluded)

    def weights(self, batch: Batch, drawing: Drawing) -> torch.Tensor:
        """The plain fit's; with the target `box`, 1 in the box and 0 elsewhere."""
        if self.settings.target == "mask":
            return super().weights(batch, drawing)
        weights = torch.zeros_like(batch.masks)
        for weight, (left, top, right, bottom) in zip(
            weights, self.boxes[batch.rows].tolist(), strict=True
        ):
            weight[top:bottom, left:right] = 1.0
        return weights

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """The photometric loss; no occluder without need, and no hole in the hand."""
        assert isinstance(drawing, OccludedDrawing)
        settings = self.settings
        target = batch.images
        if settings.target == "box":
            target = shares_of_255(self.material.frames.images[batch.rows], target.device)
        loss = photometric_loss(drawing.image, target, weights, settings.dssim_weight)
        holes = (batch.masks * (1.0 - drawing.coverage[..., 0])).mean()
        return (
            loss + settings.occluder_weight * drawing.occluded.mean() + settings.hole_weight * holes
        )

    @torch.no_grad()
    def move_back(self, batch: Batch) -> None:
        """Keep the tensors within their ranges."""
        super().move_back(batch)
        low, high = _SIGMAS
        self.occluders.log_sigmas.clamp_(math.log(low), math.log(high))


class OccluderMethod(RecipeMethod):
    """The plain fit behind occluders of each frame's own; see `OccluderRecipe`."""

    name = "baselines/occluder-splats"
    settings_type = OccluderSettings
    recipe_type = OccluderRecipe
