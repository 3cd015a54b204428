"""A displaced mesh of opaque discs with a texture, times a network's shadows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, normalize

from hwp_bench.methods.settings import number
from wildghand.gaussians.hand_avatar import PosedHands
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import AnchorPoses, HandRig
from wildghand.network.surface import CellPooling, FixedGather, PlaneSampler
from wildghand.plain.recipe import Drawing, LoopSettings
from wildghand.splat import rasterize

_WIDTH = 16
# Axis-angle of fifteen joints, and two columns of the wrist's rotation.
_POSE = 45 + 6
# Before the sigmoid: most of the skin is in the light.
_LIT = 2.0


@dataclass(frozen=True)
class ScanSettings(LoopSettings):
    """Those of the loop, and those of the two stages."""

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
    shadow_rate: float = 3e-3
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
    #: Weight of the shadows' total variation over the texture plane.
    shadow_smoothness: float = number(0.0, 0.0, 1e4)
    #: Weight of the total variation of texels that no training frame shows.
    unseen_smoothness: float = number(0.1, 0.0, 1e4)


class ShadowNet(nn.Module):
    """Three convolutions over the texture plane; one sigmoid channel.

    Args:
        uv: (N, 2) the anchors' texture coordinates, in [0, 1].
        channels: of what is known of each anchor in a frame.
        cells: along an edge of the plane.
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
    """One hand: what is fitted of it, and how an anchor is displaced and coloured.

    Args:
        uv: (N, 2) texture coordinates of the anchors.
        color: (3,) sRGB of the skin at the start.
    """

    def __init__(self, rig: HandRig, uv: Tensor, color: Tensor, settings: ScanSettings) -> None:
        super().__init__()
        count, corners = len(rig), rig.template.faces[rig.anchors.face_index]
        weights = torch.as_tensor(rig.anchors.barycentric, dtype=torch.float32)
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
