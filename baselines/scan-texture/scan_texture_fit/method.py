"""The fit of a displaced mesh, its texture and its shadows, in the manner of UHM."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample, leaky_relu, max_pool2d, normalize

from hwp_bench.base.numerics import kd_tree
from hwp_bench.hands.anchors import anchor_uv
from hwp_bench.methods.contract import Avatar
from hwp_bench.methods.settings import number
from wildghand.gaussians.hand_avatar import DrawnAvatar, PosedHands
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.regularizers import surface_laplacian
from wildghand.gaussians.rig import AnchorPoses, HandRig, make_rig
from wildghand.gaussians.training import TrainingClip
from wildghand.network.surface import CellPooling, FixedGather, PlaneSampler
from wildghand.plain.pose_corrections import PoseCorrections
from wildghand.plain.recipe import Batch, Drawing, FitInputs, LoopSettings, Recipe, RecipeMethod
from wildghand.splat import rasterize
from wildghand.visibility.count import seen_anchors

_WIDTH = 16
# Axis-angle of fifteen joints, and two columns of the wrist's rotation.
_POSE = 45 + 6
# Before the sigmoid: most of the skin is in the light.
_LIT = 2.0


@dataclass(frozen=True)
class ScanSettings(LoopSettings):
    """Settings of the loop, and those of the two stages."""

    #: Texels along an edge of the texture.
    texture_size: int = number(512, 16, 2048)
    #: Share of the budget of stage 1: shape, poses and shadows, with one colour of the skin.
    shape_share: float = number(0.3, 0.01, 0.99)
    #: Steps of what stage 1 fits while stage 2 fits the texture, as a share (UHM: 1e-5 of 1e-4).
    late_rate: float = number(0.1, 0.0, 1.0)
    #: Adam step of the shape parameters.
    betas_rate: float = 3e-3
    #: Adam step of the displacement of each vertex along its normal, m.
    displacement_rate: float = 1e-4
    #: Adam step of the corrections of training frames' joint angles, rad.
    pose_rate: float = 3e-4
    #: Adam step of the corrections of a hand's place in training frames, m.
    transl_rate: float = 3e-4
    #: Adam step of the skin's colour in stage 1.
    color_rate: float = 0.01
    #: Adam step of the shadow network's weights.
    shadow_rate: float = 0.01
    #: Adam step of the texels.
    texture_rate: float = 0.01
    #: Standard deviation of a Gaussian along the surface, in units of the anchors' spacing.
    width: float = number(0.55, 0.2, 2.0)
    #: Cells along an edge of the plane on which the shadow network works.
    shadow_cells: int = number(64, 4, 256)
    #: Whether the shadow network sees posed normals, and not only how they face the camera.
    normals: bool = True
    #: Weight of the coverage's distance to the mask.
    mask_weight: float = number(0.1, 0.0, 1e4)
    #: Weight of the roughness of the displacements over the surface.
    displacement_smoothness: float = number(1e-3, 0.0, 1e4)
    #: Weight of the shadows' distance to 1 (UHM: 0.1, of an L1 of weight 1).
    shadow_one: float = number(1e-3, 0.0, 1e4)
    #: Weight of the total variation of texels that no training frame shows.
    unseen_smoothness: float = number(0.1, 0.0, 1e4)


class ShadowNet(nn.Module):
    """Three convolutions over a square texture plane of `cells` cells; one sigmoid channel.

    Its input has `channels` values for each anchor in a frame.
    """

    coordinates: Tensor

    def __init__(self, uv: Tensor, channels: int, cells: int) -> None:
        super().__init__()
        self._cells = cells
        self._pool = CellPooling(uv, cells)
        self._read = PlaneSampler(uv, cells)
        known = torch.cat((2.0 * uv - 1.0, torch.ones(len(uv), 1)), dim=-1)
        self.register_buffer("coordinates", self._planes(known[None]), persistent=False)
        self.first = nn.Conv2d(channels + known.shape[1], _WIDTH, 3, padding=1)
        self.pose = nn.Linear(_POSE, _WIDTH, bias=False)
        self.second = nn.Conv2d(_WIDTH, _WIDTH, 3, padding=1)
        self.last = nn.Conv2d(_WIDTH, 1, 3, padding=1)
        with torch.no_grad():
            # The wrist's turns reach further than those of fingers; neither may drown the view.
            self.pose.weight.mul_(0.3)
            self.last.weight.mul_(0.1)
            assert self.last.bias is not None
            self.last.bias.fill_(_LIT)

    def _planes(self, values: Tensor) -> Tensor:
        """(B, N, C) to (B, C, cells, cells), means over the anchors of each cell."""
        frames, count, channels = values.shape
        means = self._pool(values.permute(1, 0, 2).reshape(count, frames * channels))
        return means.reshape(self._cells, self._cells, frames, channels).permute(2, 3, 0, 1)

    def forward(self, known: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the shadows of B frames.

        Args:
            known: (B, N, channels) of each anchor, such as how it faces the camera.
            pose: (B, 16, 3) axis-angle, rad.

        Returns:
            (B, N) in (0, 1), 1 is full light; and the plane that they are read from,
            (B, 1, cells, cells).
        """
        frames = len(known)
        planes = torch.cat(
            (self._planes(known), self.coordinates.expand(frames, -1, -1, -1)), dim=1
        )
        turned = torch.cat((pose[:, 1:].flatten(1), _two_columns(pose[:, 0])), dim=-1)
        hidden = leaky_relu(self.first(planes) + self.pose(turned)[..., None, None], 0.1)
        plane = self.last(leaky_relu(self.second(hidden), 0.1)).sigmoid()
        rows = plane.reshape(frames, -1).mT.contiguous()
        return self._read(rows).mT, plane


def _two_columns(axis_angle: Tensor) -> Tensor:
    """(B, 3) axis-angle to the first two columns of the rotations, (B, 6): no jump at a turn."""
    angle = axis_angle.norm(dim=-1, keepdim=True).clamp(min=1e-8)
    axis = axis_angle / angle
    x, y, z = axis.unbind(dim=-1)
    none = torch.zeros_like(x)
    cross = torch.stack((none, -z, y, z, none, -x, -y, x, none), dim=-1).reshape(-1, 3, 3)
    sine, cosine = angle.sin()[..., None], angle.cos()[..., None]
    rotation = torch.eye(3).to(axis) + sine * cross + (1.0 - cosine) * (cross @ cross)
    return rotation[..., :2].flatten(1)


# Thickness of a disc in units of the anchors' spacing, and its opacity.
_THICKNESS, _OPACITY = 0.1, 0.98


@dataclass(frozen=True, eq=False)
class ScanDrawing(Drawing):
    """B frames as the model draws them."""

    #: (B, 1, cells, cells) the shadows of each hand.
    shadows: tuple[Tensor, ...]


class ScanHand(nn.Module):
    """One hand: what is fitted of it, and how an anchor is displaced and coloured."""

    def __init__(self, rig: HandRig, uv: Tensor, color: Tensor, settings: ScanSettings) -> None:
        super().__init__()
        count, corners = len(rig), rig.template.faces[rig.anchors.face_index].cpu()
        weights = torch.as_tensor(rig.anchors.barycentric, dtype=torch.float32).cpu()
        self._from_vertices = FixedGather(
            torch.arange(count).repeat_interleave(3),
            corners.flatten(),
            weights.flatten(),
            count,
            len(rig.template.vertices),
        )
        self._texels = PlaneSampler(uv, settings.texture_size)
        self.betas = nn.Parameter(torch.zeros(10))
        self.displacement = nn.Parameter(torch.zeros(len(rig.template.vertices), 1))
        self.texture = nn.Parameter(color.repeat(settings.texture_size**2, 1))
        self.shadow = ShadowNet(uv, 4 if settings.normals else 1, settings.shadow_cells)
        self._normals = settings.normals

    def raised(self) -> Tensor:
        """(N, 1) m, how far each anchor lies above the template's skin."""
        return self._from_vertices(self.displacement)

    def albedo(self) -> Tensor:
        """(N, 3) sRGB in full light, read from the texture."""
        return self._texels(self.texture)

    def shadows(self, posed: AnchorPoses, viewmats: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """See `ShadowNet.forward`."""
        normals = quat_third_axis(posed.orientations)
        centres = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]
        view = normalize(centres[:, None] - posed.positions.detach(), dim=-1)
        known = (normals * view).sum(dim=-1, keepdim=True)
        if self._normals:
            known = torch.cat((known, normals), dim=-1)
        return self.shadow(known, pose)


class ScanModel(nn.Module):
    """One or two scanned hands; see `ScanHand`."""

    textured: Tensor

    def __init__(
        self,
        rigs: Mapping[str, HandRig],
        uv: Mapping[str, Tensor],
        color: Tensor,
        settings: ScanSettings,
    ) -> None:
        super().__init__()
        self.rigs = dict(rigs)
        self.width = settings.width
        self.hands = nn.ModuleDict(
            {side: ScanHand(rig, uv[side], color, settings) for side, rig in rigs.items()}
        )
        #: (3,) colour of the whole skin, which stage 1 has instead of a texture.
        self.color = nn.Parameter(color.clone())
        # A tensor, so that states of a fit hold it.
        self.register_buffer("textured", torch.zeros(()))

    def hand(self, side: str) -> ScanHand:
        """One hand."""
        return cast("ScanHand", self.hands[side])

    def fitted(self) -> dict[str, Tensor]:
        """The tensors that are fitted: the colour, then those of each hand, as `betas.right`."""
        found: dict[str, Tensor] = {"color": self.color}
        for side, hand in self.hands.items():
            found |= {f"{name}.{side}": value for name, value in hand.named_parameters()}
        return found

    def follow(self, side: str, pose: Tensor, betas: Tensor, transl: Tensor) -> AnchorPoses:
        """The anchors of a hand of this person; see `HandRig.follow`."""
        return self.rigs[side].follow(pose, betas + self.hand(side).betas, transl)

    def draw(
        self, hands: PosedHands, viewmats: Tensor, Ks: Tensor, width: int, height: int
    ) -> ScanDrawing:
        """Draw B frames over black; differentiable. See `HandAvatar.draw`."""
        means, quats, scales, colors, planes = [], [], [], [], []
        for side, (pose, betas, transl) in hands.items():
            hand = self.hand(side)
            posed = self.follow(side, pose, betas, transl)
            shadows, plane = hand.shadows(posed, viewmats, pose)
            albedo = hand.albedo() if bool(self.textured) else self.color
            normals = quat_third_axis(posed.orientations)
            means.append(posed.positions + normals * hand.raised())
            quats.append(posed.orientations)
            disc = posed.positions.new_tensor((self.width, self.width, _THICKNESS))
            scales.append((disc * self.rigs[side].spacing).expand(len(normals[0]), 3))
            colors.append(albedo * shadows[..., None])
            planes.append(plane)
        count = sum(len(one) for one in scales)
        image, coverage, _ = rasterize(
            torch.cat(means, dim=1),
            torch.cat(quats, dim=1),
            torch.cat(scales),
            means[0].new_full((count,), _OPACITY),
            torch.cat(colors, dim=1),
            viewmats,
            Ks,
            width,
            height,
        )
        return ScanDrawing(image, coverage, tuple(planes))


def weighted_median(values: Tensor, weights: Tensor) -> Tensor:
    """The smallest value that at least half of the weight does not exceed.

    Args:
        values: (R, N, C).
        weights: (R, N), not negative.

    Returns:
        (N, C); 0 where all weights are 0.
    """
    order = values.argsort(dim=0)
    ranked = values.gather(0, order)
    share = weights[..., None].expand_as(values).gather(0, order).cumsum(dim=0)
    total = share[-1:]
    first = (share >= 0.5 * total).to(torch.int8).argmax(dim=0, keepdim=True)
    found = ranked.gather(0, first)[0]
    return torch.where(total[0] > 0.0, found, torch.zeros_like(found))


def read_pixels(images: Tensor, pixels: Tensor) -> Tensor:
    """Bilinear values of images (B, H, W, C) at places (B, N, 2) px: (B, N, C)."""
    height, width = images.shape[1:3]
    size = pixels.new_tensor((width, height))
    grid = (2.0 * pixels / size - 1.0)[:, None]
    found = grid_sample(images.movedim(-1, 1), grid, align_corners=False, padding_mode="border")
    return found[:, :, 0].mT


def nearest_anchor(uv: Tensor, size: int) -> Tensor:
    """The anchor whose texture coordinates are nearest to each texel's centre: (size^2,) int64."""
    place = (torch.arange(size) + 0.5) / size
    rows, columns = torch.meshgrid(1.0 - place, place, indexing="ij")
    texels = torch.stack((columns.flatten(), rows.flatten()), dim=-1)
    _, index = kd_tree(uv.double().cpu().numpy()).query(texels.double().numpy())
    return torch.from_numpy(index)


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

    def __init__(self, material: FitInputs, settings: ScanSettings) -> None:
        super().__init__(material, settings)
        training, device = material.training, material.device
        templates = {side: training.template(side) for side in training.sides}
        rigs = {
            side: make_rig(template, settings.gaussians, material.seed, device)
            for side, template in templates.items()
        }
        self._uv = {
            side: torch.as_tensor(anchor_uv(templates[side], rig.anchors), dtype=torch.float32)
            for side, rig in rigs.items()
        }
        torch.manual_seed(material.seed)
        # Made on the CPU, of tensors that are there, and brought to the device as a whole.
        color = material.frames.mean_color()
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

    def state(self) -> dict[str, Tensor]:
        """See `Recipe`."""
        return {**self.parameters(), "textured": self.model.textured}

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
        self.average.forget()  # its texture is not this one

    def avatar(self, steps: int) -> Avatar:
        """See `Recipe`."""

        def draw(*given: Any) -> tuple[Tensor, Tensor]:
            drawn = self.model.draw(*given)
            return drawn.image, drawn.coverage

        return DrawnAvatar(draw, self.model.rigs, self.device, steps)


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
