"""The scanned hands: displaced surfaces covered with opaque discs, texture times shadow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from scan_texture_fit.settings import ScanSettings
from scan_texture_fit.shadow import ShadowNet
from wildghand.gaussians.hand_avatar import HandAvatar, PosedHands
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import AnchorPoses, HandRig
from wildghand.network.surface import FixedGather, PlaneSampler
from wildghand.splat import rasterize

# Thickness of a disc in units of the anchors' spacing, and its opacity.
_THICKNESS, _OPACITY = 0.1, 0.98


@dataclass(frozen=True, eq=False)
class ScanDrawing:
    """B frames as the model draws them."""

    #: (B, H, W, 3) sRGB over black.
    image: Tensor
    #: (B, H, W, 1) coverage in [0, 1].
    coverage: Tensor
    #: (B, 1, cells, cells) the shadows of each hand.
    shadows: tuple[Tensor, ...]


class ScanHand(nn.Module):
    """One hand: what is fitted of it, and how an anchor is displaced and coloured.

    Args:
        rig: the hand.
        uv: (N, 2) texture coordinates of the anchors.
        color: (3,) sRGB of the skin at the start.
        settings: sizes.
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
        """See `ShadowNet.forward`.

        Args:
            posed: the anchors in B frames.
            viewmats: (B, 4, 4) world to camera.
            pose: (B, 16, 3) axis-angle, rad.
        """
        normals = quat_third_axis(posed.orientations)
        centres = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]
        view = normalize(centres[:, None] - posed.positions.detach(), dim=-1)
        known = (normals * view).sum(dim=-1, keepdim=True)
        if self._normals:
            known = torch.cat((known, normals), dim=-1)
        return self.shadow(known, pose)


class ScanModel(nn.Module):
    """One or two scanned hands.

    Args:
        rigs: by side.
        uv: (N, 2) texture coordinates of the anchors, by side.
        color: (3,) sRGB of the skin at the start.
        settings: sizes.
    """

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
        found = self.hands[side]
        assert isinstance(found, ScanHand)
        return found

    def follow(self, side: str, pose: Tensor, betas: Tensor, transl: Tensor) -> AnchorPoses:
        """The anchors of a hand of this person; see `HandRig.follow`."""
        return self.rigs[side].follow(pose, betas + self.hand(side).betas, transl)

    def draw(
        self,
        hands: Mapping[str, tuple[Tensor, Tensor, Tensor]],
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
    ) -> ScanDrawing:
        """Draw B frames over black; differentiable.

        Args:
            hands: pose (B, 16, 3), betas (10,) and translation (B, 3) by side.
            viewmats: (B, 4, 4) world to camera.
            Ks: (B, 3, 3) px.
            width, height: px.
        """
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


class ScanAvatar(HandAvatar):
    """The fitted model.

    Args:
        model: what to draw; while the fit goes on it may be the live one.
        steps: optimizer steps behind it.
    """

    def __init__(self, model: ScanModel, steps: int) -> None:
        super().__init__(model.rigs, model.color.device, steps)
        self.model = model

    def draw(
        self, hands: PosedHands, viewmats: Tensor, Ks: Tensor, width: int, height: int
    ) -> tuple[Tensor, Tensor]:
        """See `HandAvatar.draw`."""
        drawn = self.model.draw(hands, viewmats, Ks, width, height)
        return drawn.image, drawn.coverage
