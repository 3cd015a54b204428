"""The identity map and the four heads, each of which starts at a given output."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from wildghand.gaussians.attributes import CHANNELS, SIZES, RawAttributes, flat_gaussians
from wildghand.network.settings import NetworkSettings
from wildghand.network.surface import POSITION_CHANNELS, SurfacePoints

# How far a raw attribute moves with its channel of the identity map. One rate of Adam moves all
# channels alike, so these are the ratios of the rates at which attributes are best fitted.
_GAINS = {
    "offsets": 1.0,
    "log_scales": 0.4,
    "quats": 0.4,
    "logit_opacities": 1.6,
    "logit_colors": 1.0,
}
#: `_GAINS` for each of the 14 channels.
DIRECT_GAINS = tuple(gain for name, gain in _GAINS.items() for _ in range(SIZES[name]))
#: Share of the brightest sRGB that an albedo may start from, so that it can still grow.
BRIGHTEST = 0.95


class IdentityMap(nn.Module):
    """One square of learnable features for each hand: the two halves of the paper's atlas.

    A capture of one hand has one half only.
    """

    def __init__(self, settings: NetworkSettings, sides: Iterable[str]) -> None:
        super().__init__()
        self.resolution = settings.identity_resolution
        self.maps = nn.ParameterDict()
        for side in sides:
            values = torch.randn(self.resolution**2, settings.identity_channels).clamp_(-1.0, 1.0)
            values *= settings.identity_spread
            if settings.direct:
                values[:, :CHANNELS] = 0.0
            self.maps[side] = nn.Parameter(values)

    def forward(self, side: str) -> Tensor:
        """Return a hand's half: (resolution^2, channels), row by row from the top."""
        return self.maps[side]


def initial_attributes(
    settings: NetworkSettings, surface: SurfacePoints, log_scale_bias: float
) -> RawAttributes:
    """Flat discs of the hand's mean colour, as seen through the initial shadow coefficient.

    `log_scale_bias` is what the activation adds to the log scales.
    """
    spacing = torch.full((len(surface),), float(surface.spacing))
    albedo = (surface.color / settings.initial_shadow).clamp(0.0, BRIGHTEST)
    discs = flat_gaussians(spacing, albedo, opacity=settings.initial_opacity)
    return RawAttributes(
        offsets=discs.offsets,
        log_scales=discs.log_scales - log_scale_bias,
        quats=discs.quats,
        logit_opacities=discs.logit_opacities[:, None],
        logit_colors=discs.logit_colors,
    )


def hidden(inputs: int, width: int, layers: int) -> nn.Sequential:
    """Linear layers of `width`, each followed by a SiLU."""
    parts: list[nn.Module] = []
    for _ in range(layers):
        parts += [nn.Linear(inputs, width), nn.SiLU()]
        inputs = width
    return nn.Sequential(*parts)


def mlp(inputs: int, width: int, outputs: int, layers: int) -> nn.Sequential:
    """`hidden` layers and a linear one behind them, which starts at zero."""
    last = nn.Linear(width, outputs)
    return nn.Sequential(*hidden(inputs, width, layers), zeroed(last))


class AttributeHead(nn.Module):
    """Head (i): raw attributes from both branches; `direct` adds the map's first channels.

    Without `frame_opacities` the opacities are the texture branch's alone.
    """

    of_frame: Tensor

    def __init__(self, settings: NetworkSettings, texture: int, geometry: int) -> None:
        super().__init__()
        width = settings.head_width
        self.texture = hidden(texture, width, settings.head_layers)
        self.geometry = hidden(geometry, width, settings.head_layers)
        # One linear layer for each attribute, side by side.
        self.attributes = zeroed(nn.Linear(width, CHANNELS))
        moved = dict.fromkeys(SIZES, 1.0) | {"logit_opacities": float(settings.frame_opacities)}
        of_frame = torch.tensor([moved[name] for name, size in SIZES.items() for _ in range(size)])
        self.register_buffer("of_frame", of_frame[:, None], persistent=False)
        self.direct: nn.Linear | None = None
        if settings.direct:
            self.direct = nn.Linear(settings.identity_channels, CHANNELS, bias=False)
            with torch.no_grad():
                self.direct.weight.zero_()
                self.direct.weight[:, :CHANNELS] = torch.diag(torch.tensor(DIRECT_GAINS))

    def frame_weights(self) -> Tensor:
        """(14, width) weights of the hidden layer on the geometry features."""
        return self.attributes.weight * self.of_frame

    def forward(
        self, hidden: Tensor, x_g: Tensor | None, latent: Tensor, initial: Tensor
    ) -> RawAttributes:
        """Raw attributes (B, N, k).

        `hidden` (N, width) is from the texture features, `x_g` (B, N, Fg) the geometry features
        (None: the texture branch alone, (N, k)),
        `latent` (N, I) the identity features (I is 0 without the direct path), `initial` (N, 14)
        the start.
        """
        change = self.attributes(hidden)
        if x_g is not None:
            change = change + linear(self.geometry(x_g), self.frame_weights())
        canonical = initial.to(change.dtype)
        if self.direct is not None:
            canonical = canonical + self.direct(latent)
        return RawAttributes.split(canonical + change)


class ShadowHead(nn.Module):
    """Head (ii): the shadow coefficient from geometry features only.

    The logit is linear in the features plus a small network: light on a matte surface is linear
    in the harmonics of the normal.
    """

    def __init__(self, settings: NetworkSettings, geometry: int) -> None:
        super().__init__()
        self.start = math.log(settings.initial_shadow / (1.0 - settings.initial_shadow))
        self.light = zeroed(nn.Linear(geometry, 1, bias=False))
        self.detail = mlp(geometry, settings.head_width, 1, settings.head_layers)

    def forward(self, x_g: Tensor) -> Tensor:
        """(B, N, Fg) to (B, N, 1) in (0, 1)."""
        return torch.sigmoid(self.start + self.light(x_g) + self.detail(x_g))


class TemplateHead(nn.Module):
    """Head (iii): offsets of the template from texture features and the encoded position."""

    def __init__(self, settings: NetworkSettings, texture: int) -> None:
        super().__init__()
        self.bound = settings.max_template_offset
        inputs = texture + POSITION_CHANNELS
        self.offsets = mlp(inputs, settings.head_width, 3, settings.head_layers)

    def forward(self, x_t: Tensor, position: Tensor) -> Tensor:
        """(N, Ft) and (N, 18) to (N, 3) m in the anchors' frames, each at most the bound."""
        first = self.offsets[0]
        assert isinstance(first, nn.Linear)
        # The position needs no gradient and x_t no copy: the layer on both is taken apart.
        width = x_t.shape[-1]
        seen = linear(x_t, first.weight[:, :width], first.bias)
        seen = seen + linear(position, first.weight[:, width:])
        return self.bound * torch.tanh(self.offsets[1:](seen))


class RefinementHead(nn.Module):
    """Head (iv): corrections of pose, shape and translation from the mean of both features.

    The shape belongs to the hand, not to a frame: it sees the texture features only.
    """

    def __init__(self, settings: NetworkSettings, texture: int, geometry: int) -> None:
        super().__init__()
        self.max_pose = settings.max_pose
        self.max_betas = settings.max_betas
        self.max_transl = settings.max_transl
        width, layers = settings.head_width, settings.head_layers
        self.frame = mlp(texture + geometry, width, 48 + 3, layers)
        self.shape = mlp(texture, width, 10, layers)

    def shape_change(self, hand: Tensor) -> Tensor:
        """(Ft,) mean of the texture features to (10,) standard deviations."""
        return self.max_betas * torch.tanh(self.shape(hand))

    def forward(self, hand: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
        """Means of both features, (Ft,) and (B, Fg), to (B, 16, 3) rad and (B, 3) m."""
        seen = torch.cat((hand.expand(len(frame), -1), frame), dim=-1)
        values = torch.tanh(self.frame(seen))
        return self.max_pose * values[:, :48].unflatten(1, (16, 3)), self.max_transl * values[
            :, 48:
        ]


def zeroed(layer: nn.Linear) -> nn.Linear:
    """Set a layer to zero, so that training starts from no effect."""
    nn.init.zeros_(layer.weight)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer
