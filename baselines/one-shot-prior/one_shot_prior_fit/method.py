"""The fit of an identity map under a frozen network, in the manner of InterGaussianHand."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from hwp_bench.base.errors import BadInput
from hwp_bench.methods.contract import Avatar, TrainingCapture
from hwp_bench.methods.settings import choice, number
from wildghand.fitting.method import ready_fit
from wildghand.gaussians.hand_avatar import DrawnAvatar, PosedHands
from wildghand.gaussians.perceptual import FilterBankLoss
from wildghand.gaussians.training import TrainingClip, TrainingFrames
from wildghand.model.model import make_model
from wildghand.model.settings import read_settings
from wildghand.network import NetworkSettings
from wildghand.network.branches import CompactTexture
from wildghand.network.heads import IdentityMap
from wildghand.network.surface import Chart
from wildghand.plain.recipe import Batch, Drawing, FitInputs, LoopSettings, Recipe, RecipeMethod
from wildghand.prior.prior import choose_prior

# What the network of the prior is fitted with in WildGHand, of which nothing acts here.
_FIT = {"dpd.enabled": False, "pao.enabled": False, "prepass.enabled": False}


class BiasedTexture(CompactTexture):
    """The texture branch with a learned bias on each hand's plane of features.

    Planes are read linearly, so that the bias is read apart and added.
    """

    def __init__(self, settings: NetworkSettings, sides: Iterable[str]) -> None:
        super().__init__(settings)
        cells, width = settings.plane_resolution**2, settings.plane_width
        self.plane_bias = nn.ParameterDict(
            {side: nn.Parameter(torch.zeros(cells, width)) for side in sides}
        )

    def forward(self, chart: Chart, identity: IdentityMap, side: str) -> Tensor:
        """Features of N Gaussians: (N, channels), the identity features first."""
        features = super().forward(chart, identity, side)
        bias = chart.planes[0](self.plane_bias[side])
        return features + nn.functional.pad(bias, (features.shape[1] - bias.shape[1], 0))


class OneShotModel:
    """A hand of the prior, of which only what `parameters` names may change.

    The network's colours start from `mean_color`; gain and offset, (3,) each, act on those of all
    Gaussians.
    """

    def __init__(
        self,
        training: TrainingCapture,
        gaussians: int,
        mean_color: Tensor,
        frame_count: int,
        seed: int,
        device: torch.device,
    ) -> None:
        settings = read_settings({**_FIT, "gaussians": gaussians})
        templates = {side: training.template(side) for side in training.sides}
        self.model = make_model(templates, settings, mean_color, frame_count, seed, device)
        network = self.model.network
        prior = choose_prior(settings, training.hand_model, network)
        if prior is None:
            raise BadInput(
                f"has no prior, and {training.hand_model.name} is the capture's",
                field="hand_model",
                remedy="This method fits captures of the free hand model only.",
            )
        prior.initialise(network)
        biased = BiasedTexture(settings.network.build(), templates).to(device)
        biased.load_state_dict(network.texture_branch.state_dict(), strict=False)
        network.texture_branch = biased
        self.model.requires_grad_(False)
        self.plane_bias = dict(biased.plane_bias.items())
        self.gain = torch.ones(3, device=device)
        self.offset = torch.zeros(3, device=device)

    def parameters(self) -> dict[str, Tensor]:
        """The fitted tensors by name."""
        maps = self.model.network.identity.maps
        return {
            **{f"identity.{side}": values for side, values in maps.items()},
            **{f"bias.{side}": values for side, values in self.plane_bias.items()},
            "color.gain": self.gain,
            "color.offset": self.offset,
        }

    def colored(self, image: Tensor, coverage: Tensor) -> Tensor:
        """Gain and offset on every Gaussian's colour, (B, H, W, 3) sRGB over black.

        Blending is linear in the colours, so the image is changed instead of them.
        """
        return image * self.gain + coverage * self.offset

    def draw(
        self, hands: PosedHands, viewmats: Tensor, Ks: Tensor, width: int, height: int
    ) -> tuple[Tensor, Tensor]:
        """See `HandAvatar.draw`."""
        image, coverage = self.model.draw(hands, viewmats, Ks, width, height, refine=True)
        return self.colored(image, coverage), coverage


@dataclass(frozen=True)
class OneShotSettings(LoopSettings):
    """How the frozen prior is adapted to a person; the weights of terms are the original's."""

    #: Gaussians on each hand.
    gaussians: int = number(12_337, 1, 1_000_000)
    #: Share of D-SSIM in the reconstruction; the rest is L1.
    dssim_weight: float = number(0.0, 0.0, 1.0)
    #: Training frames that are fitted: `clip`, all of them; `one`, see `choose_frame`.
    frames: str = choice("clip", "one")
    #: Rates fall smoothly to `final_rate` (`geometric`), or by half after 2, 5, 10, 20, 35, 50 and
    #: 75 % of the budget (`halving`, the original's).
    decay: str = choice("geometric", "halving")
    #: Adam step of the identity map; the original's is 0.01.
    identity_rate: float = number(0.1)
    #: Adam step of the bias of the texture plane.
    bias_rate: float = number(0.01)
    #: Adam step of gain and offset.
    color_rate: float = number(0.01)
    #: Weight of the reconstruction.
    reconstruction: float = number(10.0)
    #: Weight of a perceptual distance; a bank of filters, because VGG's weights need a file.
    perceptual: float = number(0.1)
    #: Weight of the coverage's distance to the mask.
    mask: float = number(1.0)
    #: Weight of the mean square of the bias.
    bias: float = number(0.01)


# Frames whose hand is at least this share of the largest one show as much of it.
_LARGE = 0.9


def choose_frame(frames: TrainingFrames) -> int:
    """The row of the frame that shows much of the hand, and shows it sharply.

    Among the frames whose mask has at least nine tenths of the largest mask's area, it is the one
    with the largest mean magnitude of the Laplacian within the mask: blur and covered skin
    lower one or the other. The first of equals is taken.
    """
    areas = (frames.masks > 127).flatten(1).sum(dim=1).numpy()
    rows = np.flatnonzero(areas >= _LARGE * areas.max())
    sharp = [_edge_strength(frames, row) for row in rows.tolist()]
    return int(rows[int(np.argmax(sharp))])


def only(frames: TrainingFrames, row: int) -> TrainingFrames:
    """One row of the training frames."""
    part = slice(row, row + 1)
    return TrainingFrames(frames.indices[part], frames.images[part], frames.masks[part])


def _edge_strength(frames: TrainingFrames, row: int) -> float:
    image = frames.images[row].numpy().astype(np.float32).mean(axis=-1)
    # The outline against the background says nothing of the skin.
    mask = (frames.masks[row].numpy() > 127).astype(np.uint8)
    inside = cv2.erode(mask, np.ones((3, 3), np.uint8)) > 0
    if not inside.any():
        return 0.0
    return float(np.abs(cv2.Laplacian(image, cv2.CV_32F))[inside].mean())


#: Shares of the budget after which rates are halved: the original's epochs of its hundred.
HALVED_AFTER = (0.02, 0.05, 0.10, 0.20, 0.35, 0.50, 0.75)


class OneShotRecipe(Recipe[OneShotSettings]):
    """Fit the identity map, the bias of the texture plane, and one gain and offset."""

    def __init__(self, material: FitInputs, settings: OneShotSettings) -> None:
        if settings.frames == "one":
            frames = only(material.frames, choose_frame(material.frames))
            material = replace(material, frames=frames)
        super().__init__(material, settings)
        training, frames, device = material.training, material.frames, material.device
        color = frames.mean_color()
        self.fitted = OneShotModel(
            training, settings.gaussians, color, len(frames), material.seed, device
        )
        self.clip = TrainingClip(training, frames.indices, self.fitted.model.rigs, device)
        self._perceptual = FilterBankLoss()

    def parameters(self) -> dict[str, torch.Tensor]:
        """See `Recipe`."""
        return self.fitted.parameters()

    def rate(self, name: str, fraction: float) -> float:
        """See `Recipe`."""
        if self.settings.decay == "geometric":
            return super().rate(name, fraction)
        halvings = sum(fraction >= share for share in HALVED_AFTER)
        return self.rates()[name] * 0.5**halvings

    def draw(self, batch: Batch) -> Drawing:
        """See `Recipe`."""
        training = self.material.training
        drawn = self.fitted.model.draw_frames(
            self.clip, batch.rows, training.width, training.height, refine=True
        )
        return Drawing(self.fitted.colored(drawn.image, drawn.coverage), drawn.coverage)

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """See `Recipe`."""
        settings = self.settings
        total = settings.reconstruction * super().loss(batch, drawing, weights)
        if settings.perceptual:
            distance = self._perceptual(drawing.image, batch.images, weights)
            total = total + settings.perceptual * distance
        if settings.mask:
            total = total + settings.mask * self.outline(batch, drawing, weights)
        squares = [bias.square().mean() for bias in self.fitted.plane_bias.values()]
        return total + settings.bias * torch.stack(squares).mean()

    def avatar(self, steps: int) -> Avatar:
        """See `Recipe`."""
        return DrawnAvatar(self.fitted.draw, self.fitted.model.rigs, self.device, steps)


class OneShotMethod(RecipeMethod):
    """See `one_shot_prior_fit.method.OneShotRecipe` for all that it does."""

    name = "baselines/one-shot-prior"
    settings_type = OneShotSettings
    recipe_type = OneShotRecipe

    def __init__(self, settings: Mapping[str, Any], seed: int = 0) -> None:
        super().__init__(settings, seed)
        ready_fit(self.settings.device)
