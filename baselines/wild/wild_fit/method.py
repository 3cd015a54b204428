"""The plain fit with an appearance and an uncertainty of each frame."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch.nn.functional import softplus

from hwp_bench.methods.contract import Camera, HandPose
from hwp_bench.methods.settings import choice, number
from wildghand.gaussians.losses import photometric_loss
from wildghand.gaussians.training import TrainingFrames
from wildghand.plain.model import PlainAvatar, PlainModel
from wildghand.plain.recipe import Batch, Drawing, FitInputs, FitSettings, PlainRecipe, RecipeMethod
from wildghand.splat.threads import denormals_flushed

#: Octaves of the Gaussians' numbers at the start; each is a sine and a cosine by axis.
OCTAVES = 4
#: Numbers that stand for a Gaussian.
GAUSSIAN_FEATURES = 6 * OCTAVES

# The network gives gain and offset by colour, uncertainty, transient colour, transient share.
_OUTPUTS = (3, 3, 1, 3, 1)
# Where softplus is 1, the uncertainty at the start.
_ONE = math.log(math.e - 1.0)
# The transient share starts at 5 %.
_RARE = -3.0


@dataclass(frozen=True, eq=False)
class Appearance:
    """How N Gaussians look in B frames."""

    #: (B, N, 3) sRGB without light, with the frame's gain and offset; within [0, 1].
    colors: torch.Tensor
    #: (B, N, 1) uncertainty, positive.
    uncertainty: torch.Tensor
    #: (B, N, 3) colour of what is only in this frame, in [0, 1].
    transient: torch.Tensor
    #: (B, N, 1) its share, in [0, 1].
    share: torch.Tensor


def start_appearance(
    places: torch.Tensor, frames: int, frame_features: int, hidden: int, seed: int
) -> dict[str, torch.Tensor]:
    """The tensors before the first step, by name: `frame` (R, E), `gaussian` (N, 24), the network.

    Places (N, 3) are those of `places_at_rest`. Source: the code of WildGaussians.
    """
    random, device = torch.Generator().manual_seed(seed), places.device

    def layer(outputs: int, inputs: int) -> torch.Tensor:
        values = 2.0 * torch.rand(outputs, inputs, generator=random) - 1.0
        return (values / math.sqrt(inputs)).to(device)

    octaves = 2.0 * math.pi * 2.0 ** torch.arange(OCTAVES, device=device)
    phases = (places[..., None] * octaves).flatten(1)
    inputs = 3 + GAUSSIAN_FEATURES + frame_features
    return {
        "frame": 0.01 * torch.randn(frames, frame_features, generator=random).to(device),
        "gaussian": torch.cat((phases.sin(), phases.cos()), dim=-1),
        "network.layer_1": layer(hidden, inputs),
        "network.bias_1": torch.zeros(hidden, device=device),
        "network.layer_2": layer(hidden, hidden),
        "network.bias_2": torch.zeros(hidden, device=device),
        "network.layer_3": layer(sum(_OUTPUTS), hidden),
        "network.bias_3": torch.zeros(sum(_OUTPUTS), device=device),
    }


def appear(
    tensors: Mapping[str, torch.Tensor],
    colors: torch.Tensor,
    frame: torch.Tensor,
    tone_scale: float,
) -> Appearance:
    """Change the colours of the Gaussians as some frames do; differentiable in all tensors.

    Args:
        tensors: as `start_appearance` names them.
        colors: (N, 3) sRGB without light.
        frame: (B, E) the numbers of B frames.
        tone_scale: factor on the gains and offsets.

    Source: Kulhanek et al., "WildGaussians", where the gain starts at 0; here it
    starts at 1, so that the first step is the plain fit's.
    """
    known = torch.cat((colors, tensors["gaussian"]), dim=-1)
    split = known.shape[-1]
    first = tensors["network.layer_1"]
    # The share of the frame is the same for all Gaussians.
    hidden = (known @ first[:, :split].T)[None] + (frame @ first[:, split:].T)[:, None]
    hidden = (hidden + tensors["network.bias_1"]).relu()
    hidden = (hidden @ tensors["network.layer_2"].T + tensors["network.bias_2"]).relu()
    made = (hidden @ tensors["network.layer_3"].T + tensors["network.bias_3"]).split(
        _OUTPUTS, dim=-1
    )
    gain, offset = 1.0 + tone_scale * made[0], tone_scale * made[1]
    return Appearance(
        colors=(colors * gain + offset).clamp(0.0, 1.0),
        uncertainty=softplus(made[2] + _ONE),
        transient=made[3].sigmoid(),
        share=(made[4] + _RARE).sigmoid(),
    )


def places_at_rest(corners: torch.Tensor, barycentric: torch.Tensor) -> torch.Tensor:
    """Where Gaussians in triangles (N, 3, 3) are at rest, in the hand's own size: (N, 3).

    They are centred at 0.5; 97 % of the coordinates of each axis lie in [0, 1]. Along an axis in
    which they have no extent, as a single one has none, they all lie at 0.5.
    """
    places = (corners * barycentric[..., None]).sum(dim=1)
    places = places - places.mean(dim=0)
    size = torch.quantile(places.abs(), 0.97, dim=0)
    return 0.5 + 0.5 * places / torch.where(size > 0.0, size, 1.0)


# What the geometry gets of the gradient of the uncertainty: nothing that matters.
_LITTLE = 1e-4


def laplace_loss(error: torch.Tensor, sigma: torch.Tensor, least: float) -> torch.Tensor:
    """Negative log likelihood of errors under a Laplace distribution, without its constant."""
    return error / sigma + torch.log(sigma / least)


def gauss_loss(square: torch.Tensor, beta: torch.Tensor, least: float) -> torch.Tensor:
    """Negative log likelihood of errors under a normal distribution, without its constant.
    Returns:
        r^2 / (2 beta^2) + log(beta / least); smallest at beta = |r|.

    Source: Martin-Brualla et al., "NeRF in the Wild".
    """
    return square / (2.0 * beta.square()) + torch.log(beta / least)


def certain(sigma: torch.Tensor) -> torch.Tensor:
    """Whether 1 / (2 sigma^2) > 1: which pixels a fit keeps.

    Source: the code of WildGaussians.
    """
    return 2.0 * sigma.square() < 1.0


def before_drawing(channel: torch.Tensor) -> torch.Tensor:
    """The same values; their gradient gets back what `after_drawing` took off."""
    return _ScaledGradient.apply(channel, 1.0 / _LITTLE)


def after_drawing(channel: torch.Tensor) -> torch.Tensor:
    """The same values; their gradient is made small.

    The rasterizer draws the uncertainty with the colours in one pass. Between these two functions
    its gradient is so small that the Gaussians' places and opacities do not follow it: they are
    for the image, and a Gaussian must not move to where an error is.
    """
    return _ScaledGradient.apply(channel, _LITTLE)


class _ScaledGradient(torch.autograd.Function):
    """The identity with a factor on its gradient."""

    @staticmethod
    def forward(ctx: Any, values: torch.Tensor, factor: float) -> torch.Tensor:
        ctx.factor = factor
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:
        return gradient * ctx.factor, None


@dataclass(frozen=True)
class WildSettings(FitSettings):
    """Settings of the plain fit, and how appearance and uncertainty are fitted."""

    #: Numbers that stand for a frame.
    frame_features: int = number(32, 1, 1024)
    #: Units in each of the two hidden layers.
    hidden: int = number(128, 1, 4096)
    #: Factor on the network's gains and offsets.
    tone_scale: float = number(1.0, 0.0, 100.0)
    #: Whether D-SSIM compares the colours without the frame's appearance; `nerf-w` has no D-SSIM.
    plain_dssim: bool = True
    #: Adam step of the frames' numbers.
    frame_rate: float = 0.01
    #: Adam step of the Gaussians' numbers.
    gaussian_rate: float = 5e-3
    #: Adam step of the network.
    network_rate: float = 2e-3
    #: How the uncertainty acts: `mask` leaves uncertain pixels out; `nerf-w` divides by it, with
    #: a transient colour that is left out of tests; `none` fits the appearance alone.
    uncertainty: str = choice("mask", "nerf-w", "none")
    #: The error that an uncertainty of 1 stands for, sRGB in a frame of mean brightness.
    error_unit: float = number(1.0, 1e-6, 1.0)
    #: Least uncertainty.
    least_uncertainty: float = number(0.1, 1e-6, 1e6)
    #: `mask`: share of the fit before pixels are left out.
    mask_from: float = number(0.3, 0.0, 1.0)
    #: `nerf-w`: weight of the mean share of the transient colour.
    transient_weight: float = number(0.01, 0.0, 1e6)
    #: Share of the frames, the least uncertain ones, whose mean stands for test frames.
    test_share: float = number(0.5, 0.0, 1.0)


class WildAvatar:
    """See `hwp_bench.methods.contract.Avatar`.

    Args:
        bake: makes the plain model that is drawn; called when the first image is asked for, since
            a fit offers an avatar after each step and few of them are drawn.
    """

    def __init__(self, bake: Callable[[], PlainModel], steps: int, device: str) -> None:
        self._bake = bake
        self.steps = steps
        self.device = device

    @functools.cached_property
    def plain(self) -> PlainAvatar:
        """The plain avatar with the colours that test frames have."""
        with denormals_flushed(), torch.no_grad():
            return PlainAvatar(self._bake(), self.steps)

    def render(self, hands: Mapping[str, HandPose], camera: Camera) -> np.ndarray:
        """Draw the hands that are given; see `PlainAvatar.render`."""
        return self.plain.render(hands, camera)


# Colours of the finished avatar stay this far from 0 and 1, where their logits are finite.
_ROOM = 1e-4


@dataclass(frozen=True, eq=False)
class WildDrawing(Drawing):
    """A batch with what a frame's appearance adds."""

    #: (B, H, W, 3) sRGB over black in the colours that all frames share; (B, H, W, 0) where the
    #: loss does not look at them.
    shared: torch.Tensor
    #: (B, H, W) uncertainty in units of the error; 1 where nothing is drawn.
    uncertainty: torch.Tensor
    #: scalar, the mean share of transient colours.
    transient: torch.Tensor


class WildRecipe(PlainRecipe[WildSettings]):
    """See `PlainRecipe`.

    Attributes:
        tensors: numbers of frames and Gaussians, and the network's weights.
        brightness: (R,) mean sRGB of the hand in each frame, in that of all frames. Errors are
            divided by it: else a dark frame would seem to fit well.
        frame_uncertainty: (R,) the scale of the Laplace distribution that explains a frame's errors
            best, which is their mean, over all times that it was drawn; infinite before.
    """

    def __init__(self, material: FitInputs, settings: WildSettings) -> None:
        super().__init__(material, settings)
        places = []
        for rig in self.model.rigs.values():
            template, anchors = rig.template, rig.anchors
            corners = template.vertices[template.faces[anchors.face_index]]
            places.append(places_at_rest(corners, torch.as_tensor(anchors.barycentric)))
        frames, sizes = len(material.frames), (settings.frame_features, settings.hidden)
        self.tensors = start_appearance(torch.cat(places), frames, *sizes, material.seed)
        self.brightness = _brightness(material.frames)
        self.frame_uncertainty = torch.full((len(material.frames),), torch.inf)
        self._drawn = torch.zeros(len(material.frames))

    def parameters(self) -> dict[str, torch.Tensor]:
        """The plain fit's, and those of the appearance."""
        return {**super().parameters(), **self.tensors}

    @property
    def _compares_shared(self) -> bool:
        """Whether the loss looks at the colours that all frames share."""
        return self.settings.plain_dssim and self.settings.uncertainty != "nerf-w"

    def draw(self, batch: Batch) -> WildDrawing:
        """Draw the frames in their own and in the shared colours, with the uncertainty."""
        training, clip, model = self.material.training, self.clip, self.model
        rows = batch.rows.to(self.material.device)
        poses = clip.poses(batch.rows)
        shared = model.gaussians.logit_colors.sigmoid()
        look = self.appear(shared, self.tensors["frame"][rows])
        own = look.colors
        if self.settings.uncertainty == "nerf-w":
            own = (1.0 - look.share) * own + look.share * look.transient
        channels = (
            model.lit(own, poses),
            before_drawing(look.uncertainty),
            *([model.lit(shared, poses)] if self._compares_shared else []),
        )
        drawn, coverage = model.rasterized(
            torch.cat(channels, dim=-1),
            poses,
            clip.viewmats[rows],
            clip.Ks[rows],
            training.width,
            training.height,
        )
        uncertainty = after_drawing(drawn[..., 3]) + (1.0 - coverage[..., 0].detach())
        return WildDrawing(
            image=drawn[..., :3].contiguous(),
            coverage=coverage,
            shared=drawn[..., 4:].contiguous(),
            uncertainty=uncertainty.clamp(min=self.settings.least_uncertainty),
            transient=look.share.mean(),
        )

    def weights(self, batch: Batch, drawing: Drawing) -> torch.Tensor:
        """The plain fit's, and 0 at the hand's uncertain pixels."""
        assert isinstance(drawing, WildDrawing)
        weights = super().weights(batch, drawing)
        hand = batch.masks > 0.5
        self._judge(batch.rows, self._errors(batch, drawing), hand)
        settings = self.settings
        if settings.uncertainty != "mask" or batch.fraction < settings.mask_from:
            return weights
        return weights * (certain(drawing.uncertainty.detach()) | ~hand)

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """Photometric loss in the frame's colours, and the loss of the uncertainty."""
        assert isinstance(drawing, WildDrawing)
        settings = self.settings
        sigma, least = drawing.uncertainty, settings.least_uncertainty
        if settings.uncertainty == "nerf-w":
            error = (drawing.image - batch.images) / settings.error_unit
            fit = gauss_loss(error.square().mean(dim=-1), sigma, least)
            return (fit * weights).mean() + settings.transient_weight * drawing.transient
        share = settings.dssim_weight
        if self._compares_shared:
            loss = (1.0 - share) * photometric_loss(drawing.image, batch.images, weights, 0.0)
            loss = loss + share * photometric_loss(drawing.shared, batch.images, weights, 1.0)
        else:
            loss = photometric_loss(drawing.image, batch.images, weights, share)
        if settings.uncertainty == "none":
            return loss
        fit = laplace_loss(self._errors(batch, drawing) / settings.error_unit, sigma, least)
        return loss + (fit * batch.masks).mean()

    def _errors(self, batch: Batch, drawing: Drawing) -> torch.Tensor:
        """Mean error of each pixel by the frame's brightness, (B, H, W), without gradient."""
        errors = (drawing.image.detach() - batch.images).abs().mean(dim=-1)
        return errors / self.brightness[batch.rows].to(errors.device)[:, None, None]

    def _judge(self, rows: torch.Tensor, errors: torch.Tensor, hand: torch.Tensor) -> None:
        """Take note of how badly frames fit."""
        for place, row in enumerate(rows.tolist()):
            mean, before = errors[place][hand[place]].mean().cpu(), self._drawn[row]
            held = self.frame_uncertainty[row] * before if before else 0.0
            self.frame_uncertainty[row] = (held + mean) / (before + 1.0)
            self._drawn[row] += 1.0

    def appear(self, colors: torch.Tensor, frame: torch.Tensor) -> Appearance:
        """How Gaussians of some colours, (N, 3), look in frames of some numbers, (B, E)."""
        return appear(self.tensors, colors, frame, self.settings.tone_scale)

    def test_frame(self) -> torch.Tensor:
        """(1, E) the mean numbers of the least uncertain frames, which stand for test frames."""
        order = torch.argsort(self.frame_uncertainty, stable=True)
        kept = order[: max(1, round(self.settings.test_share * len(order)))]
        return self.tensors["frame"][kept.to(self.material.device)].mean(0, keepdim=True)

    def avatar(self, steps: int) -> WildAvatar:
        """The avatar in the look of the least uncertain frames, without transient colours."""
        return WildAvatar(self._baked, steps, str(self.material.device))

    @torch.no_grad()
    def _baked(self) -> PlainModel:
        """A plain model with the colours of test frames."""
        model = self.model.snapshot()
        shared = model.gaussians.logit_colors.sigmoid()
        colors = self.appear(shared, self.test_frame()).colors[0]
        logits = torch.logit(colors.clamp(_ROOM, 1.0 - _ROOM))
        return replace(model, gaussians=replace(model.gaussians, logit_colors=logits))


def _brightness(frames: TrainingFrames) -> torch.Tensor:
    """(R,) mean sRGB of the hand in each frame, as a share of the mean of all frames."""
    # One of 255 more, so that a black frame has a brightness.
    pairs = zip(frames.images, frames.masks, strict=True)
    brightness = torch.stack([image[mask > 127].float().mean() + 1.0 for image, mask in pairs])
    return brightness / brightness.mean()


class WildMethod(RecipeMethod):
    """The plain fit with an appearance and an uncertainty of each training frame."""

    name = "baselines/wild"
    settings_type = WildSettings
    recipe_type = WildRecipe
