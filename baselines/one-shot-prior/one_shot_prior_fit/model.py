"""The frozen prior with what is fitted of it: identity map, plane bias, gain and offset."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from hwp_bench.base.errors import BadInput
from hwp_bench.methods.contract import TrainingCapture
from wildghand.gaussians.hand_avatar import PosedHands
from wildghand.model.model import make_model
from wildghand.model.settings import read_settings
from wildghand.network import NetworkSettings
from wildghand.network.branches import CompactTexture
from wildghand.network.heads import IdentityMap
from wildghand.network.surface import Chart
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
    """A hand of the prior, and the few tensors that make it a person's.

    Args:
        training: the capture.
        gaussians: on each hand.
        mean_color: (3,) sRGB of the hand, which the network's colours start from.
        frame_count: training frames.
        seed: of the places of the Gaussians.
        device: where it lives.

    Attributes:
        model: the network's hands; only what `parameters` names may change.
        gain: (3,) on the colours of all Gaussians.
        offset: (3,) added to them.
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

        Blending is linear in the colours, so that the image may be changed in their place.
        """
        return image * self.gain + coverage * self.offset

    def draw(
        self, hands: PosedHands, viewmats: Tensor, Ks: Tensor, width: int, height: int
    ) -> tuple[Tensor, Tensor]:
        """See `HandAvatar.draw`."""
        image, coverage = self.model.draw(hands, viewmats, Ks, width, height, refine=True)
        return self.colored(image, coverage), coverage
