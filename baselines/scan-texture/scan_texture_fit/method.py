"""The fit of a displaced mesh, its texture and its shadows, in the manner of UHM."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from hwp_bench.hands.anchors import anchor_uv
from hwp_bench.methods.contract import Avatar
from scan_texture_fit.model import ScanDrawing, ScanModel, ScanSettings
from scan_texture_fit.unwrap import nearest_anchor, read_pixels, weighted_median
from wildghand.evidence.count import seen_anchors
from wildghand.gaussians.hand_avatar import DrawnAvatar
from wildghand.gaussians.regularizers import surface_laplacian
from wildghand.gaussians.rig import make_rig
from wildghand.gaussians.training import TrainingClip
from wildghand.plain.pose_corrections import PoseCorrections
from wildghand.plain.recipe import Batch, Drawing, Material, Recipe, RecipeMethod

# Displacements stay within these, m.
_FARTHEST = 0.008
# Texels stay below this: shadows are at most 1.
_BRIGHTEST = 2.0
# A texel is unseen where the weights of the frames that show it sum up to less than this.
_LEAST_WEIGHT = 0.3
# Most frames that are unwrapped; of longer clips as many, evenly spread.
_MOST_FRAMES = 256


class ScanRecipe(Recipe[ScanSettings]):
    """Stage 1: shape, poses of training frames, and shadows, with one colour. Stage 2: texture.

    Between the stages the frames are unwrapped into the texture.

    Attributes:
        shown: by side, (N,) weight of the frames that show each anchor; set by the unwrapping.
        unseen: by side, (size, size) 1 where no frame shows a texel; set by the unwrapping.
    """

    def __init__(self, material: Material, settings: ScanSettings) -> None:
        super().__init__(material, settings)
        training, device = material.training, material.device
        templates = {side: training.template(side) for side in training.sides}
        rigs = {
            side: make_rig(template, settings.gaussians, material.seed, device)
            for side, template in templates.items()
        }
        self._uv = {
            side: torch.as_tensor(
                anchor_uv(templates[side], rig.anchors), dtype=torch.float32, device=device
            )
            for side, rig in rigs.items()
        }
        torch.manual_seed(material.seed)
        color = material.frames.mean_color().to(device)
        self.model = ScanModel(rigs, self._uv, color, settings).to(device)
        self.clip = TrainingClip(training, material.frames.indices, rigs, device)
        self.corrections = PoseCorrections(self.clip)
        self._laplacians = {side: surface_laplacian(rig) for side, rig in rigs.items()}
        size = settings.texture_size
        self.shown: dict[str, Tensor] = {}
        self.unseen = {side: torch.zeros(size, size, device=device) for side in rigs}

    def parameters(self) -> dict[str, Tensor]:
        """See `Recipe`."""
        return {**self.model.fitted(), **self.corrections.parameters()}

    def rate(self, name: str, fraction: float) -> float:
        """See `Recipe`. The texture waits for stage 2, in which the rest moves slowly."""
        late = fraction >= self.settings.shape_share
        if name.startswith("texture."):
            return super().rate(name, fraction) if late else 0.0
        return super().rate(name, fraction) * (self.settings.late_rate if late else 1.0)

    def draw(self, batch: Batch) -> ScanDrawing:
        """See `Recipe`."""
        if batch.fraction >= self.settings.shape_share and not bool(self.model.textured):
            self.unwrap()
        training, clip = self.material.training, self.clip
        rows = batch.rows.to(self.device)
        hands, viewmats, Ks = self.corrections.hands(rows), clip.viewmats[rows], clip.Ks[rows]
        return self.model.draw(hands, viewmats, Ks, training.width, training.height)

    def loss(self, batch: Batch, drawing: Drawing, weights: Tensor) -> Tensor:
        """See `Recipe`: the photometric loss, the silhouette, and what keeps each part smooth."""
        assert isinstance(drawing, ScanDrawing)
        settings = self.settings
        loss = super().loss(batch, drawing, weights)
        loss = loss + settings.mask_weight * self.outline(batch, drawing, weights)
        for plane in drawing.shadows:
            loss = loss - settings.shadow_one * plane.clamp(min=1e-4).log().mean()
            loss = loss + settings.shadow_smoothness * total_variation(plane[:, 0])
        for side, laplacian in self._laplacians.items():
            hand = self.model.hand(side)
            rough = laplacian.roughness(hand.raised() / laplacian.spacing)
            loss = loss + settings.displacement_smoothness * rough
            if bool(self.model.textured) and settings.unseen_smoothness:
                texture = hand.texture.reshape(*self.unseen[side].shape, 3)
                varies = total_variation(texture.movedim(-1, 0), self.unseen[side])
                loss = loss + settings.unseen_smoothness * varies
        return loss

    @torch.no_grad()
    def move_back(self, batch: Batch) -> None:
        """See `Recipe`."""
        for side in self.model.rigs:
            hand = self.model.hand(side)
            hand.displacement.clamp_(-_FARTHEST, _FARTHEST)
            hand.texture.clamp_(0.0, _BRIGHTEST)

    @torch.no_grad()
    def unwrap(self) -> None:
        """Fill the texture with medians of frames divided by their shadows.

        Places that no frame shows get the skin's colour.
        """
        model, clip, (images, masks) = self.model, self.clip, self._tables
        count = len(self.material.frames)
        values: dict[str, list[Tensor]] = {side: [] for side in model.rigs}
        weights: dict[str, list[Tensor]] = {side: [] for side in model.rigs}
        chosen = torch.linspace(0, count - 1, min(count, _MOST_FRAMES)).round().long()
        for rows in chosen.split(16):
            here = rows.to(self.device)
            viewmats, image, mask = clip.viewmats[here], images(rows), masks(rows)
            hands = self.corrections.hands(here)
            anchors = {side: model.follow(side, *given) for side, given in hands.items()}
            # A border's pixel is partly background, and it is where a wrong pose shows first.
            inner = -max_pool2d(-mask[:, None], 3, 1, 1)[:, 0]
            places = seen_anchors(anchors, viewmats, clip.Ks[here], mask.shape[1:])
            for side, (pixels, facing) in places.items():
                shadows, _ = model.hand(side).shadows(anchors[side], viewmats, hands[side][0])
                inside = read_pixels(inner[..., None], pixels)[..., 0]
                weights[side].append(facing.square() * (inside > 0.99))
                values[side].append(read_pixels(image, pixels) / shadows[..., None].clamp(min=0.05))
        size = self.settings.texture_size
        for side in model.rigs:
            weight = torch.cat(weights[side])
            colors = weighted_median(torch.cat(values[side]), weight)
            self.shown[side] = weight.sum(dim=0)
            seen = self.shown[side] > _LEAST_WEIGHT
            index = nearest_anchor(self._uv[side], size).to(colors.device)
            filled = torch.where(seen[:, None], colors, model.color)
            model.hand(side).texture.copy_(filled[index].clamp(0.0, _BRIGHTEST))
            self.unseen[side] = (~seen[index]).float().reshape(size, size)
        model.textured.fill_(1.0)

    def avatar(self, steps: int) -> Avatar:
        """See `Recipe`."""

        def draw(*given: Any) -> tuple[Tensor, Tensor]:
            drawn = self.model.draw(*given)
            return drawn.image, drawn.coverage

        return DrawnAvatar(draw, self.model.rigs, self.device, steps)

    def snapshot(self) -> dict[str, Tensor]:
        """See `Recipe`."""
        return {**super().snapshot(), "textured": self.model.textured.clone()}

    @torch.no_grad()
    def restore(self, values: dict[str, Tensor]) -> None:
        """See `Recipe`."""
        super().restore(values)
        self.model.textured.copy_(values["textured"])


def total_variation(planes: Tensor, where: Tensor | None = None) -> Tensor:
    """Mean absolute difference of neighbours in planes (B, H, W).

    Args:
        where: (H, W) weights of the pairs by their first member; None weighs all alike.
    """
    across = (planes[:, :, 1:] - planes[:, :, :-1]).abs()
    down = (planes[:, 1:] - planes[:, :-1]).abs()
    if where is not None:
        across, down = across * where[:, :-1], down * where[:-1]
    return across.mean() + down.mean()


class ScanMethod(RecipeMethod):
    """See `scan_texture_fit.method.ScanRecipe` for all that it does."""

    name = "baselines/scan-texture"
    settings_type = ScanSettings
    recipe_type = ScanRecipe
