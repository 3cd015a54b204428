"""The plain fit with an appearance and an uncertainty of each frame."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from hwp_bench.methods.contract import Camera, HandPose
from hwp_bench.methods.settings import choice, number
from wild_fit.frames import (
    Appearance,
    after_drawing,
    appear,
    before_drawing,
    certain,
    gauss_loss,
    laplace_loss,
    places_at_rest,
    start_appearance,
)
from wildghand.gaussians.losses import photometric_loss
from wildghand.gaussians.training import TrainingFrames
from wildghand.plain.model import PlainAvatar, PlainModel
from wildghand.plain.recipe import Batch, Drawing, FitSettings, Material, PlainRecipe, RecipeMethod
from wildghand.splat.threads import denormals_flushed


@dataclass(frozen=True)
class WildSettings(FitSettings):
    """Those of the plain fit, and how appearance and uncertainty are fitted."""

    #: Numbers that stand for a frame.
    frame_features: int = number(32, 1, 1024)
    #: Units in each of the two hidden layers.
    hidden: int = number(128, 1, 4096)
    #: Factor on the network's gains and offsets.
    tone_scale: float = number(1.0, 0.0, 100.0)
    #: Whether D-SSIM compares the colours without the frame's appearance.
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

    #: (B, H, W, 3) sRGB over black in the colours that all frames share.
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

    def __init__(self, material: Material, settings: WildSettings) -> None:
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
            *([model.lit(shared, poses)] if self.settings.plain_dssim else []),
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
        if settings.plain_dssim:
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
