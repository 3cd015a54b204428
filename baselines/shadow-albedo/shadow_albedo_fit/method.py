"""The plain fit under one lamp that casts shadows, in the manner of HARP."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import torch

from hwp_bench.methods.settings import number
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.regularizers import SurfaceLaplacian, surface_laplacian
from wildghand.gaussians.rig import AnchorPoses
from wildghand.gaussians.shading import MAX_DEGREE
from wildghand.plain.model import PlainModel
from wildghand.plain.recipe import Batch, Drawing, FitInputs, FitSettings, PlainRecipe, RecipeMethod
from wildghand.splat import rasterize

#: Distance from which the lamp's image is taken, m from the hand's centre.
RADIUS = 1.5
#: A point is in shadow if something is nearer to the lamp by more than this, m.
BIAS = 0.008
#: Steepness of the test, 1/m.
SHARPNESS = 1000.0
# Discs on the surface just cover it; see `flat_gaussians`.
_WIDTH, _THICKNESS, _OPACITY = 0.7, 0.1, 0.99
# Room around the hand in the lamp's image, as a factor.
_MARGIN = 1.1
# The lamp sees something where the discs cover more than this.
_LEAST_COVER = 0.5


@torch.no_grad()
def visibility(
    poses: AnchorPoses, lamp: torch.Tensor, spacing: float, size: int = 128
) -> torch.Tensor:
    """How much of the lamp each anchor sees; no gradient.

    The lamp's image is taken on a sphere around the hand's centre; a point looks at the 3 x 3
    pixels around its own.

    Args:
        poses: N anchors in B frames.
        lamp: (3,) m, world.
        spacing: distance between neighbouring anchors, m.
        size: edge of the lamp's image, px.

    Returns:
        (B, N) in [0, 1].

    Source: HARP (Karunratanakul et al. 2023), section 3.3: the mean of
    sigmoid(1000 (d_light - (d - 0.008))).
    """
    points = poses.positions
    viewmats, Ks = lamp_cameras(points, lamp, size)
    scales = points.new_tensor((_WIDTH, _WIDTH, _THICKNESS)) * spacing
    count = points.shape[1]
    depths, cover, _ = rasterize(
        points,
        poses.orientations,
        scales.expand(count, 3),
        points.new_full((count,), _OPACITY),
        points.new_zeros(count, 1),
        viewmats,
        Ks,
        size,
        size,
        render_mode="ED",
    )
    seen = torch.where(cover[..., 0] > _LEAST_COVER, depths[..., 0], torch.inf)
    in_lamp = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    depth = in_lamp[..., 2]
    pixels = in_lamp[..., :2] / depth[..., None] * Ks[:, None, (0, 1), (0, 1)] + Ks[:, None, :2, 2]
    column, row = pixels.floor().long().clamp(0, size - 1).unbind(dim=-1)
    frame = torch.arange(len(points), device=points.device)[:, None]
    total = torch.zeros_like(depth)
    for down in (-1, 0, 1):
        for across in (-1, 0, 1):
            y, x = (row + down).clamp(0, size - 1), (column + across).clamp(0, size - 1)
            total += (SHARPNESS * (seen[frame, y, x] - (depth - BIAS))).sigmoid()
    return total / 9.0


def lamp_cameras(
    points: torch.Tensor, lamp: torch.Tensor, size: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Cameras (B, 4, 4) and (B, 3, 3) towards points (B, N, 3), that just hold them all.

    They look from the lamp's direction; a lamp in the centre of the points looks along z.
    """
    center = points.mean(dim=1)
    away = lamp - center
    length = away.norm(dim=-1, keepdim=True)
    forward = torch.where(length > 1e-6, -away / length, away.new_tensor((0.0, 0.0, 1.0)))
    # Any direction that is not along the view will do for the image's right.
    axis = torch.nn.functional.one_hot(forward.abs().argmin(dim=-1), 3).to(points)
    right = torch.nn.functional.normalize(torch.linalg.cross(axis, forward), dim=-1)
    down = torch.linalg.cross(forward, right)
    viewmats = torch.eye(4, device=points.device).repeat(len(points), 1, 1)
    viewmats[:, :3, :3] = torch.stack((right, down, forward), dim=1)
    eye = center - RADIUS * forward
    viewmats[:, :3, 3] = -(viewmats[:, :3, :3] @ eye[..., None])[..., 0]
    reach = (points - center[:, None]).norm(dim=-1).amax(dim=1).clamp(1e-3, 0.9 * RADIUS)
    # The sphere that holds the points touches the view's edges.
    focal = 0.5 * size / _MARGIN * (RADIUS**2 - reach**2).sqrt() / reach
    Ks = torch.zeros(len(points), 3, 3, device=points.device)
    Ks[:, 0, 0] = Ks[:, 1, 1] = focal
    Ks[:, :2, 2] = 0.5 * size
    Ks[:, 2, 2] = 1.0
    return viewmats, Ks


@dataclass(frozen=True, eq=False)
class ShadowedModel(PlainModel):
    """The plain model, whose colours are albedos, and a lamp at one place in all frames."""

    #: (3,) m, world.
    lamp: torch.Tensor
    #: () share of the light that comes from everywhere, before the sigmoid.
    logit_ambient: torch.Tensor
    #: Edge of the lamp's image of the hand, px; 0 for a lamp that casts no shadows.
    shadow_size: int

    def parameters(self) -> dict[str, torch.Tensor]:
        """The fitted tensors by name, in a fixed order."""
        return {**super().parameters(), "lamp": self.lamp, "ambient": self.logit_ambient}

    def with_parameters(self, values: Mapping[str, torch.Tensor]) -> ShadowedModel:
        """The same rigs with other values, named as in `parameters`."""
        rest = {name: value for name, value in values.items() if name not in ("lamp", "ambient")}
        made = super().with_parameters(rest)
        assert isinstance(made, ShadowedModel)
        return replace(made, lamp=values["lamp"], logit_ambient=values["ambient"])

    def lit(self, colors: torch.Tensor, poses: AnchorPoses) -> torch.Tensor:
        """Multiply the light on albedos (N, 3) or (B, N, 3); differentiable in both."""
        # As in HARP the light is multiplied on in sRGB.
        return super().lit(colors, poses) * self.shading(poses)[..., None]

    def shading(self, poses: AnchorPoses) -> torch.Tensor:
        """(B, N) the share of the light at each anchor; differentiable in lamp and ambient."""
        towards = torch.nn.functional.normalize(self.lamp - poses.positions, dim=-1)
        facing = (quat_third_axis(poses.orientations) * towards).sum(dim=-1).relu()
        if self.shadow_size:
            spacing = max(rig.spacing for rig in self.rigs.values())
            facing = facing * visibility(poses, self.lamp.detach(), spacing, self.shadow_size)
        ambient = self.logit_ambient.sigmoid()
        return ambient + (1.0 - ambient) * facing


@dataclass(frozen=True)
class ShadowSettings(FitSettings):
    """The plain fit's settings, and those of the light."""

    #: Degree of a light by spherical harmonics on top of the lamp: 0, none, as in HARP, to 3.
    shading_degree: int = number(0, 0, MAX_DEGREE)
    #: Whether the lamp casts shadows.
    shadows: bool = True
    #: Edge of the image of the hand that the lamp sees, px.
    shadow_size: int = number(256, 16, 2048)
    #: Share of the light that comes from everywhere at the start; sigmoid(0.4), as in HARP.
    ambient: float = number(0.6, 0.01, 0.99)
    #: Adam step of the lamp's place, m.
    lamp_rate: float = 0.03
    #: Adam step of the logit of the ambient share.
    ambient_rate: float = 0.03
    #: Weight of the roughness of the albedo over the surface.
    albedo_smoothness: float = number(0.0, 0.0, 1e4)
    #: Weight of the roughness of the offsets over the surface.
    offset_smoothness: float = number(0.0, 0.0, 1e4)


# A lamp over the camera's shoulder lights most of what is seen: up and back, camera axes.
_START = (0.0, -1.0, -1.0)
# Albedos at the start are at most this.
_BRIGHTEST = 0.95


class ShadowRecipe(PlainRecipe[ShadowSettings]):
    """The plain fit of a `ShadowedModel`."""

    model: ShadowedModel

    def __init__(self, material: FitInputs, settings: ShadowSettings) -> None:
        super().__init__(material, settings)
        # Cameras and posed anchors are known from here on.
        anchors = self.clip.poses(torch.arange(1))
        turn = self.clip.viewmats[0, :3, :3].mT
        away = turn @ torch.tensor(_START, device=material.device)
        with torch.no_grad():
            self.model.lamp.copy_(anchors.positions.mean(dim=(0, 1)) + RADIUS * away / away.norm())
            # The mean colour of the frames is that of the lit hand; its albedo is brighter.
            colors = self.model.gaussians.logit_colors
            albedo = (colors.sigmoid() / self.model.shading(anchors).mean()).clamp(max=_BRIGHTEST)
            colors.copy_(torch.logit(albedo, eps=1e-6))

    def start(self) -> PlainModel:
        """The plain model, and a lamp at the origin."""
        model, settings, device = super().start(), self.settings, self.material.device
        return ShadowedModel(
            **vars(model),
            lamp=torch.zeros(3, device=device),
            logit_ambient=torch.tensor(
                math.log(settings.ambient / (1.0 - settings.ambient)), device=device
            ),
            shadow_size=settings.shadow_size if settings.shadows else 0,
        )

    @cached_property
    def laplacians(self) -> list[SurfaceLaplacian]:
        """Of each hand."""
        return [surface_laplacian(rig) for rig in self.model.rigs.values()]

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """The photometric loss, and the roughness of albedo and offsets."""
        loss = super().loss(batch, drawing, weights)
        settings, gaussians = self.settings, self.model.gaussians
        sections = self.model.sections(list(self.model.rigs))
        if not (settings.albedo_smoothness or settings.offset_smoothness):
            return loss
        for section, laplacian in zip(sections, self.laplacians, strict=True):
            if settings.albedo_smoothness:
                albedo = gaussians.logit_colors[section].sigmoid()
                loss = loss + settings.albedo_smoothness * laplacian.roughness(albedo)
            if settings.offset_smoothness:
                rough = laplacian.offsets(gaussians.offsets[section])
                loss = loss + settings.offset_smoothness * rough
        return loss


class ShadowMethod(RecipeMethod):
    """The plain fit under one lamp that casts shadows; see `ShadowRecipe`."""

    name = "baselines/shadow-albedo"
    settings_type = ShadowSettings
    recipe_type = ShadowRecipe
