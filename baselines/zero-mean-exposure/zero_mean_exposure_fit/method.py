"""The plain fit with an exposure and a chromaticity of each frame, and a controller."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch.nn.functional import adaptive_avg_pool2d

from hwp_bench.methods.contract import Avatar
from hwp_bench.methods.settings import number
from wildghand.gaussians.hand_avatar import PosedHands
from wildghand.plain.model import PlainAvatar, PlainModel
from wildghand.plain.recipe import Batch, Drawing, FitInputs, FitSettings, PlainRecipe, RecipeMethod

#: Numbers of a frame: its exposure in stops, and where four chromaticities go, two each.
NUMBERS = 1 + 8
#: Chromaticities (r, g) of blue, red, green and gray, as shares of r + g + b.
POINTS = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1 / 3, 1 / 3))
#: By how much a number of 1 moves each of them: the colours of a picture move alike by all.
REACH = (0.048, 0.05, 0.05, 0.0128)
#: The controller: edge of the image that it sees, features of a pixel there, edge of the grid of
#: their means, units of the hidden layer.
SEEN, PIXEL, GRID, HIDDEN = 15, 16, 5, 32
#: Frames from which the controller learns in a step.
REPLAYED = 32
#: Weight of what the controller has to learn; Adam's steps do not depend on it.
CONTROLLER = 0.01


@dataclass(frozen=True)
class ZeroMeanExposureSettings(FitSettings):
    """Settings of the plain fit, and how frames' numbers and the controller are fitted."""

    #: Adam step of the frames' numbers.
    frame_rate: float = 0.01
    #: Adam step of the controller; it does not fall.
    controller_rate: float = 0.01
    #: Share of the fit before the controller learns; 1: unseen frames have the mean of all.
    controller_from: float = number(0.3, 0.0, 1.0)


def develop(image: torch.Tensor, numbers: torch.Tensor) -> torch.Tensor:
    """Expose an image and move its chromaticities; differentiable.

    Args:
        image: (B, H, W, 3) colours over black.
        numbers: (B, 9) stops, then two for each of blue, red, green and gray; 0 changes nothing.

    Returns:
        (B, H, W, 3): 2^stops times the image, with the homography of (r, g, r + g + b) that
        moves the four chromaticities; r + g + b of a pixel stays that of the exposed image.

    Source: the code of PPISP.
    """
    shift = numbers[:, 1:].view(-1, 4, 2) * image.new_tensor(REACH)[:, None]
    goal = torch.cat((image.new_tensor(POINTS) + shift, torch.ones_like(shift[..., :1])), dim=-1)
    corners, gray = goal[:, :3].mT, goal[:, 3:].mT
    # Columns are where blue, red and green go; their shares make gray go where it must.
    columns = corners * torch.linalg.solve(corners, gray).mT
    # What these columns multiply: blue, red and green of a pixel.
    moved = image[..., [2, 0, 1]] @ columns[:, None].mT
    total = image.sum(dim=-1, keepdim=True) * torch.exp2(numbers[:, 0]).view(-1, 1, 1, 1)
    red_green = moved[..., :2] * (total / (moved[..., 2:] + 1e-5))
    return torch.cat((red_green, total - red_green.sum(dim=-1, keepdim=True)), dim=-1)


def start_controller(seed: int, device: torch.device) -> dict[str, torch.Tensor]:
    """The tensors of a controller that predicts zeros."""
    random = torch.Generator().manual_seed(seed)

    def layer(outputs: int, inputs: int) -> torch.Tensor:
        values = 2.0 * torch.rand(outputs, inputs, generator=random) - 1.0
        return (values / math.sqrt(inputs)).to(device)

    return {
        "controller.pixel": layer(PIXEL, 3),
        "controller.pixel_bias": torch.zeros(PIXEL, device=device),
        "controller.hidden": layer(HIDDEN, PIXEL * GRID * GRID),
        "controller.hidden_bias": torch.zeros(HIDDEN, device=device),
        "controller.out": torch.zeros(NUMBERS, HIDDEN, device=device),
        "controller.out_bias": torch.zeros(NUMBERS, device=device),
    }


def shrink(image: torch.Tensor) -> torch.Tensor:
    """Means of (B, H, W, 3) in 15 x 15 parts, for the controller; without gradient."""
    return adaptive_avg_pool2d(image.detach().movedim(-1, 1), SEEN).movedim(1, -1)


def predict(seen: torch.Tensor, controller: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """The numbers (B, 9) of frames by what `shrink` leaves of their drawings, (B, 15, 15, 3).

    A linear layer and a ReLU at each pixel, means over a grid of 5 x 5, and one hidden layer.
    """
    pixels = seen @ controller["controller.pixel"].T + controller["controller.pixel_bias"]
    means = adaptive_avg_pool2d(pixels.relu().movedim(-1, 1), GRID).flatten(1)
    hidden = means @ controller["controller.hidden"].T + controller["controller.hidden_bias"]
    return hidden.relu() @ controller["controller.out"].T + controller["controller.out_bias"]


@dataclass(frozen=True, eq=False)
class DevelopedDrawing(Drawing):
    """A batch, and what was drawn before its exposure."""

    #: (B, H, W, 3) the model's own colours over black.
    radiance: torch.Tensor


class ExposedAvatar(PlainAvatar):
    """The plain avatar with the exposure and the chromaticity that a controller predicts.

    Args:
        controller: its tensors; while the fit runs they may be the live ones.
    """

    def __init__(
        self, model: PlainModel, steps: int, controller: Mapping[str, torch.Tensor]
    ) -> None:
        super().__init__(model, steps)
        self._controller = controller

    def draw(
        self,
        hands: PosedHands,
        viewmats: torch.Tensor,
        Ks: torch.Tensor,
        width: int,
        height: int,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See `HandAvatar.draw`."""
        image, coverage = super().draw(hands, viewmats, Ks, width, height)
        return develop(image, predict(shrink(image), self._controller)), coverage


class ZeroMeanExposureRecipe(PlainRecipe[ZeroMeanExposureSettings]):
    """See `PlainRecipe`.

    Attributes:
        numbers: (R, 9) of the training frames; the mean over frames is 0 after each step.
        controller: predicts those of any frame from what the model draws.
    """

    def __init__(self, material: FitInputs, settings: ZeroMeanExposureSettings) -> None:
        super().__init__(material, settings)
        self.numbers = torch.zeros(len(material.frames), NUMBERS, device=material.device)
        self.controller = start_controller(material.seed, material.device)
        self._seen = torch.zeros(len(self.numbers), SEEN, SEEN, 3, device=material.device)
        self._drawn = torch.zeros(len(self.numbers), dtype=torch.bool)
        self._random = torch.Generator().manual_seed(material.seed)

    def parameters(self) -> dict[str, torch.Tensor]:
        """The plain fit's, the frames' numbers and the controller's."""
        return {**super().parameters(), "frame": self.numbers, **self.controller}

    def rate(self, name: str, fraction: float) -> float:
        """Adam's step of a tensor; that of the controller does not fall."""
        if name in self.controller:
            return self.settings.controller_rate
        return super().rate(name, fraction)

    def draw(self, batch: Batch) -> DevelopedDrawing:
        """The plain fit's image as the frame's camera exposed it."""
        drawn = super().draw(batch)
        numbers = self.numbers[batch.rows.to(self.device)]
        return DevelopedDrawing(develop(drawn.image, numbers), drawn.coverage, drawn.image)

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """The plain fit's loss, and that of the controller, which learns the frames' numbers."""
        assert isinstance(drawing, DevelopedDrawing)
        loss = super().loss(batch, drawing, weights)
        self._seen[batch.rows.to(self.device)] = shrink(drawing.radiance)
        self._drawn[batch.rows] = True
        if batch.fraction < self.settings.controller_from:
            return loss
        drawn = self._drawn.nonzero()[:, 0]
        rows = drawn[torch.randint(len(drawn), (REPLAYED,), generator=self._random)]
        rows = rows.to(self.device)
        wrong = predict(self._seen[rows], self.controller) - self.numbers[rows].detach()
        own = CONTROLLER * wrong.square().mean()
        # Its gradient alone: a loss that begins within the fit would be taken for divergence.
        return loss + (own - own.detach())

    @torch.no_grad()
    def move_back(self, batch: Batch) -> None:
        """The plain fit's, and the projection of the frames' numbers to a mean of zero."""
        super().move_back(batch)
        self.numbers -= self.numbers.mean(dim=0)

    def avatar(self, steps: int) -> Avatar:
        """The plain avatar, whose images the controller exposes."""
        return ExposedAvatar(self.model, steps, self.controller)


class ZeroMeanExposureMethod(RecipeMethod):
    """The plain fit with exposures of zero mean and a controller."""

    name = "baselines/zero-mean-exposure"
    settings_type = ZeroMeanExposureSettings
    recipe_type = ZeroMeanExposureRecipe
