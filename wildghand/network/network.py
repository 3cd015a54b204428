"""The Gaussian prediction network: identity map, two branches, four heads; and its parameters."""

from __future__ import annotations

import contextlib
import dataclasses
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hwp_bench.base.errors import ShapeMismatch, UsageError
from wildghand.gaussians.attributes import MAX_SCALE, Activation, RawAttributes
from wildghand.network.branches import CompactGeometry, CompactTexture, PaperGeometry, PaperTexture
from wildghand.network.heads import (
    AttributeHead,
    IdentityMap,
    RefinementHead,
    ShadowHead,
    TemplateHead,
    initial_attributes,
)
from wildghand.network.settings import NetworkSettings, check_sides
from wildghand.network.surface import POSITION_CHANNELS, Chart, SurfacePoints


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
class HandFeatures:
    """Predictions of the network for one hand that no frame enters."""

    #: (N, Ft) texture features x_t.
    texture: Tensor
    #: (Ft,) their mean.
    mean: Tensor
    #: (N, width) hidden layer of head (i) on them.
    hidden: Tensor
    #: (N, 3) m, displacement of the template in the anchors' frames, by head (iii).
    template_offsets: Tensor
    #: (10,) correction of the shape parameters, by head (iv).
    betas: Tensor

    def map(self, function: Callable[[Tensor], Tensor]) -> HandFeatures:
        """Apply a function to each tensor."""
        return HandFeatures(*(function(tensor) for tensor in self.tensors()))

    def tensors(self) -> tuple[Tensor, ...]:
        """Every tensor, in a fixed order."""
        return (self.texture, self.mean, self.hidden, self.template_offsets, self.betas)


@dataclass(frozen=True, eq=False)
class NetworkOutput:
    """Output of the network for one hand in B frames."""

    #: (B, N, k) attributes before `PredictionNetwork.activation`.
    raw: RawAttributes
    #: (B, N, 1) xi in (0, 1), times shading and cast shadow once a model has a light; the colour
    #: that is drawn is sigmoid(logit_colors) * shadow.
    shadow: Tensor
    #: (N, 3) m, displacement of the template in the anchors' frames.
    template_offsets: Tensor
    #: Corrections of the hand parameters.
    refinement: Refinement
    #: (B, N, 1) xi alone.
    xi: Tensor


class PredictionNetwork(nn.Module):
    """Predicts the Gaussians of one or two hands.

    The state dict holds what is learned and nothing else: it fits any number of anchors. What
    belongs to the anchors (samplers, initial attributes) is made again from `surfaces`.

    Args:
        settings: dimensions and bounds.
        surfaces: the anchors of each hand, by side.
        seed: of the initial weights; the same seed gives the same network bit for bit, and the
            global random state stays as it is.
        max_scale: largest standard deviation of a Gaussian, m.

    Raises:
        UsageError: no hand, or one that is neither right nor left.
    """

    def __init__(
        self,
        settings: NetworkSettings,
        surfaces: Mapping[str, SurfacePoints],
        seed: int = 0,
        *,
        max_scale: float = MAX_SCALE,
    ) -> None:
        super().__init__()
        check_sides(surfaces)
        self.settings = settings
        #: Multiply matrices in bfloat16. What comes out is float32 all the same.
        self.mixed_precision = False
        #: Turns raw attributes into drawable ones.
        self.activation = Activation(max_offset=settings.max_offset, max_scale=max_scale)
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
            self.register_buffer(f"initial_{side}", start.concatenate(), persistent=False)

    def initial(self, side: str) -> RawAttributes:
        """The raw attributes, (N, k), that head (i) starts from."""
        return RawAttributes.split(self._initial(side))

    def _initial(self, side: str) -> Tensor:
        self._chart(side)
        return self.get_buffer(f"initial_{side}")

    def texture(self, side: str) -> Tensor:
        """Texture features x_t of a hand, (N, Ft), the same in every frame."""
        return self.texture_branch(self._chart(side), self.identity, side)

    def geometry(self, side: str, normals: Tensor, pose: Tensor) -> Tensor:
        """Geometry features x_g, (B, N, Fg); see `forward`."""
        return self.geometry_branch(self._checked(side, normals, pose), normals, pose)

    def _checked(self, side: str, normals: Tensor, pose: Tensor) -> Chart:
        """The chart of a hand, if normals and pose fit it."""
        chart = self._chart(side)
        if normals.ndim != 3 or normals.shape[1:] != (len(chart), 3):
            raise ShapeMismatch(
                f"are {tuple(normals.shape)}, not (B, {len(chart)}, 3)", field="normals"
            )
        if pose.shape != (len(normals), 16, 3):
            raise ShapeMismatch(
                f"is {tuple(pose.shape)}, not ({len(normals)}, 16, 3)", field="pose"
            )
        return chart

    def features(self, side: str) -> HandFeatures:
        """Everything that the frames of a hand share: what depends on texture features only."""
        with self._precision():
            x_t = self.texture(side)
            mean = x_t.mean(dim=0)
            position = self._chart(side).coordinates[:, -POSITION_CHANNELS:]
            found = HandFeatures(
                texture=x_t,
                mean=mean,
                hidden=self.attribute_head.texture(x_t),
                template_offsets=self.template_head(x_t, position.to(x_t.dtype)),
                betas=self.refinement_head.shape_change(mean),
            )
        return found.map(torch.Tensor.float) if self.mixed_precision else found

    def forward(
        self, side: str, normals: Tensor, pose: Tensor, features: HandFeatures | None = None
    ) -> NetworkOutput:
        """Predict one hand in B frames.

        Args:
            side: the hand.
            normals: (B, N, 3) of length 1, world: the posed surface's.
            pose: (B, 16, 3) axis-angle, rad.
            features: of `features(side)`, where they are at hand already.

        Raises:
            UsageError: no such hand.
            ShapeMismatch: not N normals, or not as many poses as frames.
        """
        hand = self.features(side) if features is None else features
        with self._precision():
            x_g = self.geometry(side, normals, pose)
            latent, initial = self._latent(side), self._initial(side)
            raw = self.attribute_head(hand.hidden, x_g, latent, initial)
            shadow = self.shadow_head(x_g)
            pose_change, transl_change = self.refinement_head(hand.mean, x_g.mean(dim=1))
        if self.mixed_precision:
            raw = raw.map(torch.Tensor.float)
            shadow, pose_change, transl_change = (
                tensor.float() for tensor in (shadow, pose_change, transl_change)
            )
        return NetworkOutput(
            raw=raw,
            shadow=shadow,
            template_offsets=hand.template_offsets,
            refinement=Refinement(pose_change, hand.betas, transl_change),
            xi=shadow,
        )

    def attributes_of_texture(self, side: str, features: HandFeatures) -> RawAttributes:
        """(N, k) attributes before their activation, by the texture branch alone."""
        with self._precision():
            raw = self.attribute_head(
                features.hidden, None, self._latent(side), self._initial(side)
            )
        return raw.map(torch.Tensor.float) if self.mixed_precision else raw

    def _precision(self) -> contextlib.AbstractContextManager[object]:
        if not self.mixed_precision:
            return contextlib.nullcontext()
        device = next(self.parameters()).device
        return torch.autocast(device.type, torch.bfloat16)

    def _latent(self, side: str) -> Tensor:
        """(N, I) identity features that the direct path reads; (N, 0) without it."""
        chart = self._chart(side)
        if self.attribute_head.direct is None:
            return chart.coordinates.new_empty(len(chart), 0)
        return chart.identity(self.identity(side))

    def _chart(self, side: str) -> Chart:
        if side not in self.charts:
            raise UsageError(f"there is no {side!r} hand in this network"[:200], field="side")
        chart = self.charts[side]
        assert isinstance(chart, Chart)
        return chart


def parameter_groups(network: PredictionNetwork) -> dict[str, list[nn.Parameter]]:
    """Sort every parameter into one of five groups."""
    groups: dict[str, list[nn.Parameter]] = {
        "identity": [],
        "direct": [],
        "light": [],
        "refinement": [],
        "network": [],
    }
    prefixes = {
        "identity.": "identity",
        "attribute_head.direct.": "direct",
        "shadow_head.light.": "light",
        "refinement_head.": "refinement",
    }
    for name, parameter in network.named_parameters():
        group = next((g for prefix, g in prefixes.items() if name.startswith(prefix)), "network")
        groups[group].append(parameter)
    return groups


@dataclass(frozen=True)
class LayerRow:
    """A layer, or several of the same kind."""

    #: Path in the network; `*` stands for the number of a repeated layer.
    layer: str
    #: Shapes of its weights, in the order in which torch holds them.
    weights: str
    #: Parameters of one of them.
    each: int
    #: How many there are.
    times: int

    @property
    def parameters(self) -> int:
        """Number of parameters of all these layers."""
        return self.each * self.times

    @property
    def part(self) -> str:
        """Which part of the network it belongs to: the first name of the path."""
        return self.layer.partition(".")[0]


def parameter_table(network: PredictionNetwork) -> tuple[LayerRow, ...]:
    """Every layer that learns, in order; repeated layers of equal shape share a row."""
    counted: dict[tuple[str, str, int], int] = {}
    for path, module in network.named_modules():
        own = list(module.parameters(recurse=False))
        if own:
            layer = re.sub(r"\.\d+\.", ".*.", path)
            weights = " + ".join("x".join(map(str, tensor.shape)) for tensor in own)
            key = (layer, weights, sum(tensor.numel() for tensor in own))
            counted[key] = counted.get(key, 0) + 1
    return tuple(LayerRow(*key, times) for key, times in counted.items())


def small_network(settings: NetworkSettings) -> PredictionNetwork:
    """A network of both hands with a single anchor each: it has all weights, and draws nothing."""
    dot = SurfacePoints(
        uv=torch.full((1, 2), 0.5),
        positions=torch.zeros(1, 3),
        spacing=1e-3,
        color=torch.full((3,), 0.5),
    )
    return PredictionNetwork(settings, {"left": dot, "right": dot})


#: Start of the names of identity maps in a network's state.
MAPS = "identity.maps."


def shapes_of(network: PredictionNetwork) -> dict[str, torch.Size]:
    """Shapes of all weights of a network, and of the identity maps of both hands."""
    shapes = {name: value.shape for name, value in network.state_dict().items()}
    of_map = next(shape for name, shape in shapes.items() if name.startswith(MAPS))
    return shapes | {f"{MAPS}{side}": of_map for side in ("right", "left")}


def shapes_of_settings(settings: NetworkSettings) -> dict[str, torch.Size]:
    """The same where there is no network yet.

    The settings may come from others. What grows with a resolution could fill the memory, so it is
    made small: the identity maps, and the position of each cell in `paper`.
    """
    smallest = dataclasses.replace(settings, identity_resolution=4, plane_resolution=4)
    shapes = shapes_of(small_network(smallest))
    for name, shape in shapes.items():
        if name.startswith(MAPS):
            shapes[name] = torch.Size((settings.identity_resolution**2, *shape[1:]))
        elif name.endswith(".coder.position"):
            shapes[name] = torch.Size((settings.plane_resolution**2, *shape[1:]))
    return shapes
