"""The plain fit behind occluders of each frame's own, in the manner of DeSplat."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.methods.settings import choice, number
from wildghand.gaussians.attributes import MAX_LOGIT
from wildghand.gaussians.losses import photometric_loss
from wildghand.gaussians.training import shares_of_255
from wildghand.plain.recipe import Batch, Drawing, FitInputs, FitSettings, PlainRecipe, RecipeMethod
from wildghand.splat import rasterize

#: Depth at which occluders lie, m: nearer than any hand, beyond the rasterizer's near plane.
DISTANCE = 0.02
# Standard deviation of an occluder at the start, in units of the distance between neighbours.
_WIDTH = 0.6
# Thickness along the view, as a share of the depth: it hardly shows.
_THICKNESS = 1e-3
# The R2 sequence (Roberts): its points cover a square evenly, however many there are.
_R2_STEP = 1.0 / 1.32471795724474602596 ** np.array([1.0, 2.0])


@dataclass(frozen=True, eq=False)
class FrameOccluders:
    """M occluders in each of R frames, on the image plane."""

    #: (R, M, 2) px.
    places: torch.Tensor
    #: (R, M, 2) natural logarithms of the standard deviations along the two axes, px.
    log_sigmas: torch.Tensor
    #: (R, M) angle of the first axis, rad.
    angles: torch.Tensor
    #: (R, M) opacity before the sigmoid.
    logit_opacities: torch.Tensor
    #: (R, M, 3) sRGB colour before the sigmoid.
    logit_colors: torch.Tensor

    def parameters(self) -> dict[str, torch.Tensor]:
        """The tensors by name, in a fixed order."""
        return {
            "occluder_place": self.places,
            "occluder_shape.sigmas": self.log_sigmas,
            "occluder_shape.angles": self.angles,
            "occluder_opacity": self.logit_opacities,
            "occluder_color": self.logit_colors,
        }

    def render(
        self, rows: torch.Tensor, Ks: torch.Tensor, width: int, height: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw the occluders of frames (B,) over black: premultiplied colour, and coverage."""
        rows = rows.to(self.places.device)
        focal = Ks[:, None, (0, 1), (0, 1)]
        center = Ks[:, None, :2, 2]
        on_plane = DISTANCE * (self.places[rows] - center) / focal
        means = torch.nn.functional.pad(on_plane, (0, 1), value=DISTANCE)
        scales = torch.nn.functional.pad(
            DISTANCE * self.log_sigmas[rows].exp() / focal, (0, 1), value=_THICKNESS * DISTANCE
        )
        half = 0.5 * self.angles[rows]
        quats = torch.stack((half.cos(), 0.0 * half, 0.0 * half, half.sin()), dim=-1)
        image, coverage, _ = rasterize(
            means,
            quats,
            scales,
            self.logit_opacities[rows].sigmoid(),
            self.logit_colors[rows].sigmoid(),
            torch.eye(4, device=Ks.device).expand(len(rows), 1, 4, 4),
            Ks[:, None],
            width,
            height,
        )
        return image[:, 0], coverage[:, 0]


def mask_boxes(masks: torch.Tensor, margin: float = 0.1) -> torch.Tensor:
    """Bounding boxes of masks (R, H, W), grown by a margin and cut at the border.

    (R, 4) int64 px: left, top, right, bottom; the last two are exclusive.
    """
    height, width = masks.shape[1:]
    boxes = []
    for mask in masks > 127:
        across, down = mask.any(dim=0).nonzero()[:, 0], mask.any(dim=1).nonzero()[:, 0]
        left, right = int(across[0]), int(across[-1]) + 1
        top, bottom = int(down[0]), int(down[-1]) + 1
        grow = math.ceil(margin * max(right - left, bottom - top))
        boxes.append((left - grow, top - grow, right + grow, bottom + grow))
    limits = torch.tensor((width, height, width, height))
    return torch.tensor(boxes).clamp(min=0).minimum(limits)


def make_occluders(
    images: torch.Tensor, boxes: torch.Tensor, count: int, opacity: float, device: torch.device
) -> FrameOccluders:
    """Spread faint occluders evenly over the box of each frame (R, H, W, 3), in its colours."""
    square = torch.as_tensor((0.5 + np.arange(count)[:, None] * _R2_STEP) % 1.0)
    sizes = (boxes[:, 2:] - boxes[:, :2])[:, None].double()
    places = (boxes[:, None, :2] + square * sizes).float()
    spacing = (sizes.prod(dim=-1) / count).sqrt()  # (R, 1)
    x, y = places.long().unbind(dim=-1)
    frames = torch.arange(len(images))[:, None]
    colors = images[frames, y, x].float() / 255.0
    shape = places.shape[:2]
    return FrameOccluders(
        places=places.to(device),
        log_sigmas=(_WIDTH * spacing).log().float()[..., None].expand(*shape, 2).clone().to(device),
        angles=torch.zeros(shape, device=device),
        logit_opacities=torch.full(shape, math.log(opacity / (1.0 - opacity)), device=device),
        logit_colors=torch.logit(colors, eps=1e-6).clamp(-MAX_LOGIT, MAX_LOGIT).to(device),
    )


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

    def __init__(self, material: FitInputs, settings: OccluderSettings) -> None:
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
