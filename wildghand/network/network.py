"""The Gaussian prediction network: identity map, two branches, four heads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hwp_bench.base.errors import ShapeMismatch, UsageError
from wildghand.gaussians.attributes import Activation, RawAttributes
from wildghand.network.compact import CompactGeometry, CompactTexture
from wildghand.network.encoding import POSITION_CHANNELS
from wildghand.network.heads import AttributeHead, RefinementHead, ShadowHead, TemplateHead
from wildghand.network.identity import IdentityMap, initial_attributes
from wildghand.network.paper import PaperGeometry, PaperTexture
from wildghand.network.settings import NetworkSettings, check_sides
from wildghand.network.surface import Chart, SurfacePoints


@dataclass(frozen=True, eq=False)
class Refinement:
    """Corrections of the given hand parameters by head (iv)."""

    #: (B, 16, 3) rad, added to the axis-angle vectors.
    pose: Tensor
    #: (10,) added to the shape parameters.
    betas: Tensor
    #: (B, 3) m.
    transl: Tensor


@dataclass(frozen=True, eq=False)
class NetworkOutput:
    """Output of the network for one hand in B frames."""

    #: (B, N, k) attributes before `PredictionNetwork.activation`.
    raw: RawAttributes
    #: (B, N, 1) xi in (0, 1); the colour that is drawn is sigmoid(logit_colors) * xi.
    shadow: Tensor
    #: (N, 3) m, displacement of the template in the anchors' frames.
    template_offsets: Tensor
    #: Corrections of the hand parameters.
    refinement: Refinement
    #: (N, Ft) texture features.
    texture: Tensor


class PredictionNetwork(nn.Module):
    """Predicts the Gaussians of one or two hands.

    The state dict holds what is learned and nothing else: it fits any number of anchors. What
    belongs to the anchors (samplers, initial attributes) is made again from `surfaces`.

    Args:
        settings: dimensions and bounds.
        surfaces: the anchors of each hand, by side.
        seed: of the initial weights; the same seed gives the same network bit for bit, and the
            global random state stays as it is.

    Raises:
        UsageError: no hand, or one that is neither right nor left.
    """

    def __init__(
        self, settings: NetworkSettings, surfaces: Mapping[str, SurfacePoints], seed: int = 0
    ) -> None:
        super().__init__()
        check_sides(surfaces)
        self.settings = settings
        #: Turns raw attributes into drawable ones.
        self.activation = Activation(max_offset=settings.max_offset)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.identity = IdentityMap(settings, sorted(surfaces))
            self.texture_branch: CompactTexture | PaperTexture
            self.geometry_branch: CompactGeometry | PaperGeometry
            if settings.size == "compact":
                self.texture_branch = CompactTexture(settings)
                self.geometry_branch = CompactGeometry(settings)
            else:
                self.texture_branch = PaperTexture(settings)
                self.geometry_branch = PaperGeometry(settings)
            widths = self.texture_branch.channels, self.geometry_branch.channels
            self.attribute_head = AttributeHead(settings, *widths)
            self.shadow_head = ShadowHead(settings, widths[1])
            self.template_head = TemplateHead(settings, widths[0])
            self.refinement_head = RefinementHead(settings, *widths)
        self.charts = nn.ModuleDict()
        for side, surface in surfaces.items():
            self.charts[side] = Chart(settings, surface)
            start = initial_attributes(settings, surface, self.activation.log_scale_bias)
            for name, tensor in start.items():
                self.register_buffer(f"initial_{side}_{name}", tensor, persistent=False)

    def initial(self, side: str) -> RawAttributes:
        """The raw attributes, (N, k), that head (i) starts from.

        Raises:
            UsageError: no such hand.
        """
        self._chart(side)
        return RawAttributes(
            offsets=self.get_buffer(f"initial_{side}_offsets"),
            log_scales=self.get_buffer(f"initial_{side}_log_scales"),
            quats=self.get_buffer(f"initial_{side}_quats"),
            logit_opacities=self.get_buffer(f"initial_{side}_logit_opacities"),
            logit_colors=self.get_buffer(f"initial_{side}_logit_colors"),
        )

    def texture(self, side: str) -> Tensor:
        """Texture features x_t of a hand, the same in every frame.

        Returns:
            (N, Ft).

        Raises:
            UsageError: no such hand.
        """
        return self.texture_branch(self._chart(side), self.identity, side)

    def geometry(self, side: str, normals: Tensor, pose: Tensor) -> Tensor:
        """Geometry features x_g of a hand.

        Args:
            side: the hand.
            normals: (B, N, 3) of length 1, world: the posed surface's.
            pose: (B, 16, 3) axis-angle, rad.

        Returns:
            (B, N, Fg).

        Raises:
            UsageError: no such hand.
            ShapeMismatch: not N normals, or not as many poses as frames.
        """
        chart = self._chart(side)
        if normals.ndim != 3 or normals.shape[1:] != (len(chart), 3):
            raise ShapeMismatch(
                f"are {tuple(normals.shape)}, not (B, {len(chart)}, 3)", field="normals"
            )
        if pose.shape != (len(normals), 16, 3):
            raise ShapeMismatch(
                f"is {tuple(pose.shape)}, not ({len(normals)}, 16, 3)", field="pose"
            )
        return self.geometry_branch(chart, normals, pose)

    def forward(
        self, side: str, normals: Tensor, pose: Tensor, texture: Tensor | None = None
    ) -> NetworkOutput:
        """Predict one hand in B frames.

        Args:
            side: the hand.
            normals: (B, N, 3) of length 1, world: the posed surface's.
            pose: (B, 16, 3) axis-angle, rad.
            texture: (N, Ft) of `texture(side)`, where it is at hand already.

        Raises:
            UsageError: no such hand.
            ShapeMismatch: not N normals, or not as many poses as frames.
        """
        x_g = self.geometry(side, normals, pose)
        x_t = self.texture(side) if texture is None else texture
        position = self._chart(side).coordinates[:, -POSITION_CHANNELS:]
        return NetworkOutput(
            raw=self.attribute_head(x_t, x_g, self.initial(side)),
            shadow=self.shadow_head(x_g),
            template_offsets=self.template_head(x_t, position.to(x_t.dtype)),
            refinement=Refinement(*self.refinement_head(x_t, x_g)),
            texture=x_t,
        )

    def _chart(self, side: str) -> Chart:
        if side not in self.charts:
            raise UsageError(f"there is no {side!r} hand in this network"[:200], field="side")
        chart = self.charts[side]
        assert isinstance(chart, Chart)
        return chart
