"""The fit of a displaced mesh, its texture and its shadows, in the manner of UHM."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from hwp_bench.hands.anchors import anchor_uv
from hwp_bench.methods.contract import Avatar
from scan_texture_fit.model import ScanAvatar, ScanDrawing, ScanModel, ScanSettings
from scan_texture_fit.unwrap import nearest_anchor, unwrap
from wildghand.gaussians.regularizers import surface_laplacian
from wildghand.gaussians.rig import AnchorPoses, make_rig
from wildghand.gaussians.training import TrainingClip
from wildghand.model.terms import silhouette
from wildghand.plain.recipe import Batch, Drawing, Material, Recipe, RecipeMethod

# Displacements stay within these, m.
_FARTHEST = 0.008
# Texels stay below this: shadows are at most 1.
_BRIGHTEST = 2.0
# A texel is unseen where the weights of the frames that show it sum up to less than this.
_LEAST_WEIGHT = 0.3


class ScanRecipe(Recipe[ScanSettings]):
    """Stage 1: shape, poses of training frames, and shadows, with one colour. Stage 2: texture.

    Between the stages the frames are unwrapped into the texture.

    Attributes:
        model: what is fitted of the person.
        clip: hands and cameras of the training frames.
        poses: by side, (R, 16, 3) rad, added to the axis-angle vectors of each training frame.
        places: by side, (R, 3) m, added to the translations.
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
        given = self.clip.parameters
        self.poses = {side: torch.zeros_like(pose) for side, (pose, _, _) in given.items()}
        self.places = {side: torch.zeros_like(place) for side, (_, _, place) in given.items()}
        self._laplacians = {side: surface_laplacian(rig) for side, rig in rigs.items()}
        size = settings.texture_size
        self.shown: dict[str, Tensor] = {}
        self.unseen = {side: torch.zeros(size, size, device=device) for side in rigs}
        self._images = material.frames.images_on(device)
        self._masks = material.frames.masks_on(device)
        self._drawn: ScanDrawing | None = None

    def parameters(self) -> dict[str, Tensor]:
        """See `Recipe`."""
        return {
            **dict(self.model.named_parameters()),
            **{f"pose.{side}": value for side, value in self.poses.items()},
            **{f"transl.{side}": value for side, value in self.places.items()},
        }

    def rates(self) -> dict[str, float]:
        """See `Recipe`."""
        return {name: self._kind(name) for name in self.parameters()}

    def _kind(self, name: str) -> float:
        settings = self.settings
        kinds = {
            "betas": settings.betas_rate,
            "displacement": settings.displacement_rate,
            "texture": settings.texture_rate,
            "color": settings.color_rate,
            "pose": settings.pose_rate,
            "transl": settings.transl_rate,
        }
        parts = name.split(".")
        if "shadow" in parts:
            return settings.shadow_rate
        return kinds[parts[0] if parts[0] in kinds else parts[-1]]

    def rate(self, name: str, fraction: float) -> float:
        """See `Recipe`. The texture waits for stage 2, in which the rest moves slowly."""
        late = fraction >= self.settings.shape_share
        if name.endswith(".texture"):
            return super().rate(name, fraction) if late else 0.0
        return super().rate(name, fraction) * (self.settings.late_rate if late else 1.0)

    def corrected(self, rows: Tensor) -> dict[str, tuple[Tensor, Tensor, Tensor]]:
        """Pose, betas and translation of each hand in training frames."""
        rows = rows.to(self.material.device)
        return {
            side: (
                pose[rows] + self.poses[side][rows],
                betas,
                transl[rows] + self.places[side][rows],
            )
            for side, (pose, betas, transl) in self.clip.parameters.items()
        }

    def draw(self, batch: Batch) -> Drawing:
        """See `Recipe`."""
        if batch.fraction >= self.settings.shape_share and not bool(self.model.textured):
            self.unwrap()
        training, clip = self.material.training, self.clip
        rows = batch.rows.to(self.material.device)
        self._drawn = self.model.draw(
            self.corrected(rows),
            clip.viewmats[rows],
            clip.Ks[rows],
            training.width,
            training.height,
        )
        return Drawing(self._drawn.image, self._drawn.coverage)

    def loss(self, batch: Batch, drawing: Drawing, weights: Tensor) -> Tensor:
        """See `Recipe`: the photometric loss, the silhouette, and what keeps each part smooth."""
        settings, drawn = self.settings, self._drawn
        assert drawn is not None
        loss = super().loss(batch, drawing, weights)
        covered = drawing.coverage[..., 0]
        # Outside, the mask may be what covers the hand: it counts as little as in colours.
        loss = loss + settings.mask_weight * silhouette(covered * weights, batch.masks * weights)
        for plane in drawn.shadows:
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
        """Fill the texture from the frames; places that none shows get the skin's colour."""
        clip = self.clip

        def posed(rows: Tensor) -> dict[str, tuple[AnchorPoses, Tensor]]:
            found = {}
            for side, (pose, betas, transl) in self.corrected(rows).items():
                anchors = self.model.follow(side, pose, betas, transl)
                viewmats = clip.viewmats[rows.to(self.material.device)]
                found[side] = anchors, self.model.hand(side).shadows(anchors, viewmats, pose)[0]
            return found

        def cameras(rows: Tensor) -> tuple[Tensor, Tensor]:
            here = rows.to(self.material.device)
            return clip.viewmats[here], clip.Ks[here]

        def pictures(rows: Tensor) -> tuple[Tensor, Tensor]:
            return self._images(rows), self._masks(rows)

        size = self.settings.texture_size
        sides = list(self.model.rigs)
        for side, (colors, weight) in unwrap(
            sides, posed, cameras, pictures, len(self.material.frames)
        ).items():
            self.shown[side] = weight
            seen = weight > _LEAST_WEIGHT
            index = nearest_anchor(self._uv[side], size).to(colors.device)
            filled = torch.where(seen[:, None], colors, self.model.color)
            self.model.hand(side).texture.copy_(filled[index].clamp(0.0, _BRIGHTEST))
            self.unseen[side] = (~seen[index]).float().reshape(size, size)
        self.model.textured.fill_(1.0)

    def avatar(self, steps: int) -> Avatar:
        """See `Recipe`."""
        return ScanAvatar(self.model, steps)

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

    name: ClassVar[str] = "baselines/scan-texture"
    settings_type = ScanSettings
    recipe_type = ScanRecipe
