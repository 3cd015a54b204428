"""The plain fit: its settings, its hooks, which are all that a method may change, and its entry.

A baseline is a subclass of `PlainRecipe` that overrides the hooks in which it differs, or a
`Recipe` of its own, and a `RecipeMethod` that names it.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

import torch

from hwp_bench.methods.contract import Avatar, Budget, Report, TrainingCapture
from hwp_bench.methods.settings import choice, number, settings_from
from wildghand.gaussians.adam import LARGEST, ClippedAdam
from wildghand.gaussians.fit_loop import batches, ready_device
from wildghand.gaussians.losses import photometric_loss
from wildghand.gaussians.shading import MAX_DEGREE
from wildghand.gaussians.training import (
    FrameTable,
    TrainingClip,
    TrainingFrames,
    load_frames,
    load_judges,
    soft_weights,
)
from wildghand.plain.choice import (
    AveragedAvatar,
    Averaging,
    KeptStates,
    steps_to_first,
    validation_error,
)
from wildghand.plain.loop import IterativeFit, run_fit
from wildghand.plain.model import PlainAvatar, PlainModel, make_model
from wildghand.splat.threads import denormals_flushed

# Adam's epsilon: gradients of a mean over all pixels are small.
_EPSILON = 1e-15
_BETAS = (0.9, 0.99)
# A fit ends with a running mean of its steps, two thirds of it from the last tenth of them.
_AVERAGE_SHARE = 0.1


@dataclass(frozen=True)
class LoopSettings:
    """How long is fitted, to how many frames at a time, and what is compared.

    A method with a model of its own extends this class.
    """

    #: Gaussians on each hand.
    gaussians: int = number(12_000, 1, 1_000_000)
    #: Optimizer steps unless the budget says otherwise.
    steps: int = number(2_000, 1, 10_000_000)
    #: Frames in each step.
    batch: int = number(1, 1, 64)
    #: Share of D-SSIM in the loss; the rest is L1. 3DGS has 0.2, which poses must be right for.
    dssim_weight: float = number(0.05, 0.0, 1.0)
    #: Weight of a pixel outside the visible-hand mask; 1 inside.
    outside_weight: float = number(0.03, 0.0, 1.0)
    #: The steps' size at the end of the budget, as a share of that at its start; in between it
    #: falls geometrically.
    final_rate: float = number(0.05, 1e-6, 1.0)
    #: End with a running mean, two thirds of it from the last tenth of the steps, or with an
    #: earlier such mean that draws the validation frames better; with fewer than four of these it
    #: is the last one. Without: end with the last step.
    validated: bool = True
    #: `auto` (CUDA where both a GPU and gsplat are there), `cpu` or `cuda`.
    device: str = choice("auto", "cpu", "cuda")


@dataclass(frozen=True)
class FitSettings(LoopSettings):
    """How the plain model is fitted; `plain` was tuned to another `color_rate` (0.01).

    A method with more settings extends this class.
    """

    #: Degree of the spherical harmonics of the light, 0 (no shading) to 3.
    shading_degree: int = number(2, 0, MAX_DEGREE)
    #: Opacity of every Gaussian at the start.
    initial_opacity: float = number(0.9, 0.01, 0.99)
    #: Adam step of the offsets, m.
    offset_rate: float = 2e-4
    #: Adam step of the log scales.
    scale_rate: float = 0.01
    #: Adam step of the quaternions.
    quat_rate: float = 0.01
    #: Adam step of the logit opacities.
    opacity_rate: float = 0.05
    #: Adam step of the logit colours.
    color_rate: float = 0.03
    #: Adam step of the light.
    light_rate: float = 0.01


Settings = TypeVar("Settings", bound=LoopSettings)


@dataclass(frozen=True, eq=False)
class FitInputs:
    """The material of a fit."""

    #: What the method may see of the capture.
    training: TrainingCapture
    #: The frames to fit.
    frames: TrainingFrames
    #: Seed of all random numbers.
    seed: int
    #: Where the tensors live.
    device: torch.device


@dataclass(frozen=True, eq=False)
class Batch:
    """The B frames of one step."""

    #: Steps before this one.
    step: int
    #: Share of the budget that is used up, in [0, 1).
    fraction: float
    #: (B,) int64 on the CPU, positions in `TrainingFrames.indices`.
    rows: torch.Tensor
    #: (B, H, W, 3) sRGB in [0, 1], black outside the mask: what drawings are compared with.
    images: torch.Tensor
    #: (B, H, W) estimated coverage of the visible hand, in [0, 1].
    masks: torch.Tensor


@dataclass(frozen=True, eq=False)
class Drawing:
    """A batch of frames, drawn by a method."""

    #: (B, H, W, 3) sRGB over black.
    image: torch.Tensor
    #: (B, H, W, 1) coverage in [0, 1].
    coverage: torch.Tensor


class Recipe(IterativeFit[Avatar], Generic[Settings]):
    """A fit with its hooks. The plain fit is one; a method with a model of its own is another.

    Each step calls `draw`, `weights`, `loss` and, after Adam's step, `move_back`, which is left out
    where a gradient is not finite: nothing has moved then. What any method can have is here: the
    running mean of the steps, and the choice of an earlier state by validation frames
    (`wildghand.plain.choice`).
    Hooks keep what they need as attributes; tensors that Adam fits are named by `parameters`.

    Args:
        material: what is fitted.
        settings: how.
    """

    def __init__(self, material: FitInputs, settings: Settings) -> None:
        self.material = material
        self.settings = settings
        self.device = material.device
        self._steps = 0
        self._skipped = 0

    def parameters(self) -> dict[str, torch.Tensor]:
        """The tensors that Adam fits, by name, in a fixed order."""
        raise NotImplementedError

    def state(self) -> dict[str, torch.Tensor]:
        """All that makes a state of the fit: the fitted tensors, and others that avatars need."""
        return self.parameters()

    def rates(self) -> dict[str, float]:
        """Adam's step at the start of each tensor: of `lamp` and `lamp.left` it is `lamp_rate`."""
        rates = {name: f"{name.partition('.')[0]}_rate" for name in self.parameters()}
        settings = vars(self.settings)
        return {name: settings[rate] for name, rate in rates.items() if rate in settings}

    def draw(self, batch: Batch) -> Drawing:
        """Draw the frames of a batch; differentiable. The formation of an image is in here."""
        raise NotImplementedError

    def avatar(self, steps: int) -> Avatar:
        """The avatar that draws test frames; while the fit runs it may share live tensors."""
        raise NotImplementedError

    def rate(self, name: str, fraction: float) -> float:
        """Adam's step of a tensor after a share of the budget; it falls geometrically.

        Args:
            name: of the tensor.
            fraction: in [0, 1).
        """
        return self.rates()[name] * self.settings.final_rate**fraction

    def weights(self, batch: Batch, drawing: Drawing) -> torch.Tensor:
        """Weights of the pixels in the loss, (B, H, W), not negative.

        The plain fit has 1 where the mask shows the hand and `outside_weight` elsewhere.
        """
        return soft_weights(batch.masks, self.settings.outside_weight)

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """The scalar that Adam minimizes."""
        return photometric_loss(drawing.image, batch.images, weights, self.settings.dssim_weight)

    def outline(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """Mean square of the coverage's distance to the mask, for the loss of a subclass.

        Outside, the mask may be what covers the hand: it counts as little as in colours.
        """
        return (drawing.coverage[..., 0] * weights - batch.masks * weights).square().mean()

    def move_back(self, batch: Batch) -> None:
        """Called after Adam's step; keeps the tensors within their ranges."""

    def count_steps(self, budget: Budget) -> int:
        """See `IterativeFit`."""
        return self.settings.steps if budget.steps is None else budget.steps

    def batches(self) -> Iterator[torch.Tensor]:
        """See `IterativeFit`: (batch,) int64 each."""
        material = self.material
        return batches(len(material.frames), self.settings.batch, material.seed)

    def after_step(self) -> None:
        """See `IterativeFit`."""
        self.average.take()
        self._kept.take()

    def seconds_now(self) -> float:
        """See `IterativeFit`: about how long the choice among the states so far takes."""
        most = self._kept.most_drawn
        return most * self._seconds_to_judge if most else 0.0

    def step(self, batch: torch.Tensor, fraction: float) -> float:
        """See `IterativeFit`."""
        optimizer = self._optimizer
        for group, name in zip(optimizer.param_groups, self.parameters(), strict=True):
            group["lr"] = self.rate(name, fraction)
        images, masks = self._tables
        drawn = Batch(self._steps, fraction, batch, images(batch), masks(batch))
        drawing = self.draw(drawn)
        loss = self.loss(drawn, drawing, self.weights(drawn, drawing))
        value = float(loss.detach())
        if not math.isfinite(value):
            return value
        optimizer.clear()
        loss.backward()
        if optimizer.take_step(loss):  # a gradient is not finite: nothing has moved
            self._skipped += 1
        else:
            self.move_back(drawn)
        self._steps += 1
        return value

    def skipped(self) -> int:
        """See `IterativeFit`."""
        return self._skipped

    @functools.cached_property
    def _optimizer(self) -> ClippedAdam:
        return ClippedAdam(
            [
                {"params": [tensor.requires_grad_()], "lr": 0.0}
                for tensor in self.parameters().values()
            ],
            betas=_BETAS,
            epsilon=_EPSILON,
        )

    @functools.cached_property
    def _tables(self) -> tuple[FrameTable, FrameTable]:
        """Images and masks of the frames."""
        frames = self.material.frames
        return frames.images_on(self.device), frames.masks_on(self.device)

    def checkpoint(self, steps: int) -> Avatar:
        """See `IterativeFit`."""
        return AveragedAvatar(self.avatar(steps), self.average)

    def finish(self, steps: int, seconds: float) -> Avatar:
        """See `IterativeFit`."""
        for tensor in self.parameters().values():
            tensor.requires_grad_(False)
        self.average.put()
        self._kept.go_back(self.error, self.tell)
        return self.avatar(steps)

    @functools.cached_property
    def average(self) -> Averaging:
        """The mean of the steps so far."""
        share = _AVERAGE_SHARE if self.settings.validated else 0.0
        return Averaging(self.state().values(), share)

    @functools.cached_property
    def _judges(self) -> TrainingFrames | None:
        return load_judges(self.material.training) if self.settings.validated else None

    @functools.cached_property
    def _kept(self) -> KeptStates:
        epoch = len(self.material.frames) / self.settings.batch
        return KeptStates(self.average, 0 if self._judges is None else steps_to_first(epoch))

    def error(self, count: int | None = None) -> float:
        """Mean squared error of validation frames, or of `count` of them, as they are drawn now."""
        training, judges, avatar = self.material.training, self._judges, self.avatar(self._steps)
        assert judges is not None

        def drawn(frame: int) -> torch.Tensor:
            image = avatar.render(training.hand_poses(frame), training.camera(frame))
            return torch.from_numpy(image[..., :3])

        frames = enumerate(judges.indices[:count].tolist())
        return validation_error(judges, ((row, drawn(frame)) for row, frame in frames))

    @functools.cached_property
    def _seconds_to_judge(self) -> float:
        """About how long `error` takes, measured once; a first drawing takes longer."""
        assert self._judges is not None
        self.error(1)
        begun = time.perf_counter()
        self.error(1)
        return len(self._judges) * (time.perf_counter() - begun)

    def finite(self) -> bool:
        """Whether every fitted number is finite; one beyond `LARGEST` is not, as in gradients.

        A fit that explodes skips its steps from then on, with a loss that may be finite.
        """
        return all(bool((value.abs() <= LARGEST).all()) for value in self.parameters().values())

    def snapshot(self) -> dict[str, torch.Tensor]:
        """Copies of the state, which the fit no longer changes."""
        return {name: value.detach().clone() for name, value in self.state().items()}

    @torch.no_grad()
    def restore(self, values: dict[str, torch.Tensor]) -> None:
        """Go back to a `snapshot`."""
        for name, value in self.state().items():
            value.copy_(values[name])
        self.average.forget()
        self._kept.forget()


# Standard deviations stay within these, m: thinner than paper or wider than a finger explains
# nothing of a hand.
_SCALES = (2e-5, 1e-2)

PlainSettings = TypeVar("PlainSettings", bound=FitSettings)


class PlainRecipe(Recipe[PlainSettings]):
    """The plain fit. A method is a subclass that overrides the hooks in which it differs.

    Args:
        material: what is fitted.
        settings: how.

    Attributes:
        model: what is fitted.
        clip: hands and cameras of the training frames.
    """

    def __init__(self, material: FitInputs, settings: PlainSettings) -> None:
        super().__init__(material, settings)
        self.model = self.start()
        self.clip = TrainingClip(
            material.training, material.frames.indices, self.model.rigs, material.device
        )

    def start(self) -> PlainModel:
        """The model before the first step."""
        training, settings = self.material.training, self.settings
        return make_model(
            {side: training.template(side) for side in training.sides},
            self.material.frames.mean_color(),
            gaussians=settings.gaussians,
            opacity=settings.initial_opacity,
            degree=settings.shading_degree,
            seed=self.material.seed,
            device=self.material.device,
        )

    def parameters(self) -> dict[str, torch.Tensor]:
        """The tensors that Adam fits, by name, in a fixed order."""
        return self.model.parameters()

    def rates(self) -> dict[str, float]:
        """Adam's step at the start of each tensor, by name."""
        return {**super().rates(), **learning_rates(self.settings)}

    def draw(self, batch: Batch) -> Drawing:
        """Draw the frames of a batch; differentiable. The formation of an image is in here."""
        training, clip, rows = self.material.training, self.clip, batch.rows
        image, coverage = self.model.render(
            clip.poses(rows), clip.viewmats[rows], clip.Ks[rows], training.width, training.height
        )
        return Drawing(image, coverage)

    @torch.no_grad()
    def move_back(self, batch: Batch) -> None:
        """Called after Adam's step; keeps the tensors within their ranges."""
        low, high = _SCALES
        self.model.gaussians.log_scales.clamp_(math.log(low), math.log(high))

    def avatar(self, steps: int) -> Avatar:
        """The avatar that draws test frames; while the fit runs it may share live tensors."""
        return PlainAvatar(self.model, steps)


def learning_rates(settings: FitSettings) -> dict[str, float]:
    """Adam's step at the start of the plain model's tensors, by name."""
    return {
        "offsets": settings.offset_rate,
        "log_scales": settings.scale_rate,
        "quats": settings.quat_rate,
        "logit_opacities": settings.opacity_rate,
        "logit_colors": settings.color_rate,
        "light": settings.light_rate,
    }


class RecipeMethod:
    """See `hwp_bench.methods.contract.Method`. A method is a subclass that names its parts.

    Args:
        settings: any of the fields of `settings_type`.
        seed: of the anchors and of the order of the frames; on one machine's CPU the same seed
            and number of steps give the same avatar bit for bit.

    Raises:
        BadMethod: a setting is unknown or out of range.
        MissingDependency: CUDA was asked for and is not there.
    """

    #: Name in messages about settings.
    name: ClassVar[str]
    #: The settings' dataclass.
    settings_type: ClassVar[type[LoopSettings]] = FitSettings
    #: The recipe's class.
    recipe_type: ClassVar[type[Recipe[Any]]] = PlainRecipe

    def __init__(self, settings: Mapping[str, Any], seed: int = 0) -> None:
        self.settings = settings_from(self.settings_type, settings, self.name)
        self.seed = seed
        self.device = ready_device(self.settings.device)

    @denormals_flushed()
    def fit(self, training: TrainingCapture, budget: Budget, report: Report) -> Avatar:
        """Fit an avatar to the training frames; validation frames choose the state that it ends in.

        Args:
            training: what the method may see of the capture.
            budget: when to stop; without steps the settings' number holds.
            report: where checkpoints are offered.

        Raises:
            BadInput: no training frame can be used.
            DidNotConverge: the fit diverged at once.
        """
        material = FitInputs(training, load_frames(training), self.seed, self.device)
        return run_fit(self.recipe_type(material, self.settings), budget, report)
