"""A fit as a list of components, and one step of it.

A component is one idea of the method: it may find something before the fit, take part in each
step, and end the fit. What `Fit` adds to the loop (`wildghand.plain.loop`) are short loops over its
components. `wildghand.fitting.components` lists them; a switch leaves one out of that list.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypedDict, TypeVar

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.arrays import evenly
from hwp_bench.capture.schema import arrays_digest, hand_arrays
from hwp_bench.methods.contract import Avatar, Budget, TrainingCapture
from wildghand.avatar.avatar import FitRecord, WildGHandAvatar
from wildghand.fitting.data import FitData
from wildghand.fitting.descent import Descent, Features
from wildghand.fitting.parallel import World, digest_of
from wildghand.gaussians.fit_loop import Loss, batches
from wildghand.gaussians.training import upload
from wildghand.model.frames import RenderedFrames
from wildghand.model.model import make_model
from wildghand.model.settings import WildGHandSettings
from wildghand.plain.loop import IterativeFit

#: Largest share of a budget that is kept for the end of a fit.
MOST_OF_BUDGET = 0.5
#: Most weight masks of an avatar, spread evenly over the clip.
MAX_MASKS = 40


@dataclass(frozen=True, eq=False)
class StepBatch:
    """The frames of one step, or frames that are looked at."""

    #: (B,) int64, which of the training frames; on the CPU, the same in every process.
    rows: Tensor
    #: Those that this process draws.
    part: slice = field(default_factory=lambda: slice(None))
    #: Whether a step is taken on them.
    stepping: bool = False

    @property
    def mine(self) -> Tensor:
        """The rows that this process draws."""
        return self.rows[self.part]


@dataclass(frozen=True, eq=False)
class FrameTarget:
    """The images that the drawing of B frames is compared with, and how much each pixel counts."""

    #: (B, H, W, 3) sRGB over black outside the mask.
    image: Tensor
    #: (B, H, W) estimated coverage of the visible hand.
    hand: Tensor
    #: (B, H, W) weight of each pixel within its frame; a gradient may go through it.
    weights: Tensor
    #: What the loss is lowered by because PAO weighs much, a scalar not above 0; None: nothing.
    reward: Tensor | None = None


class DrawOptions(TypedDict, total=False):
    """How training frames are drawn; see `WildGHandModel.draw_frames`."""

    kept: Mapping[str, Tensor]
    teach: Callable[[Tensor], Tensor | None]
    move: Tensor
    features: Features
    dark: Mapping[str, Tensor]


class Component:
    """One idea of a fit. A component overrides the hooks in which it does something.

    The hooks of all components are called in the order of their list.
    """

    def prepare(self, fit: Fit) -> None:
        """Before the model is made: correct what is given, in `fit.data`."""

    def before(self, fit: Fit) -> None:
        """Before the first step: find something by the model, or give it something to keep."""

    def begin(self, fit: Fit) -> None:
        """After that, when everything that steps move is known."""

    def parameters(self) -> dict[str, Iterable[Tensor]]:
        """Parameters that Adam changes besides the model's, by the name of their rate."""
        return {}

    def draws(self, fit: Fit, batch: StepBatch) -> DrawOptions:
        """How the frames of a batch are drawn."""
        return {}

    def compare(
        self, fit: Fit, batch: StepBatch, drawing: RenderedFrames, target: FrameTarget
    ) -> FrameTarget:
        """Change the images that a batch is compared with, and how much each pixel counts."""
        return target

    def loss(
        self, fit: Fit, batch: StepBatch, drawing: RenderedFrames, target: FrameTarget
    ) -> Iterable[Tensor]:
        """Weighted terms of the loss of a batch, scalars, which are added up in their order."""
        return ()

    def loss_of_features(self, fit: Fit, features: Features) -> Tensor | None:
        """The terms that no frame enters, a scalar; None: none."""
        return None

    def after_step(self, fit: Fit) -> None:
        """After a step that was sound."""

    def forget(self) -> None:
        """The fit went back: what was noted after its steps no longer holds."""

    def checkpoint(self, avatar: Avatar) -> Avatar:
        """The avatar as it would be if the fit ended here."""
        return avatar

    def seconds(self, fit: Fit) -> float:
        """About how long `after` takes, reserved in a budget; nothing of the fit changes."""
        return 0.0

    def seconds_now(self, fit: Fit) -> float:
        """More of these, which depend on the steps so far; asked before each step."""
        return 0.0

    def after(self, fit: Fit) -> None:
        """After the last step: choose, or find what follows from the model."""

    def record(self, fit: Fit, *, final: bool) -> dict[str, Any]:
        """Fields of the avatar's `FitRecord`."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """The state that steps change, for `load_state_dict`; it may wait for the device."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state."""


Kind = TypeVar("Kind", bound=Component)


class Fit(IterativeFit[WildGHandAvatar]):
    """One fit of one capture.

    Args:
        training: what may be seen of the capture.
        settings: of the fit.
        seed: of anchors, initial weights, order of the frames, and dropout.
        device: on which it runs.
        world: the processes that share its batches.
        components: in the order in which their hooks are called.

    Raises:
        BadInput: no training frame can be used, or the prior is damaged or of another kind.
        HwpError: a checkpoint that the settings name cannot be used.
    """

    def __init__(
        self,
        training: TrainingCapture,
        settings: WildGHandSettings,
        seed: int,
        device: torch.device,
        world: World,
        components: Sequence[Component],
    ) -> None:
        self.settings = settings
        self.seed = seed
        self.device = device
        self.world = world
        self.components = components
        # By the hands as they are given, before components correct them.
        self.given = arrays_digest(hand_arrays(training.hands))
        self.data = FitData(training, device)
        for component in components:
            component.prepare(self)
        data = self.data
        self.model = make_model(
            data.templates, settings, data.mean_color, len(data.frames), seed, device, data.subject
        )
        self.model.network.mixed_precision = settings.mixed_precision and device.type == "cuda"
        self.clip = data.pose(self.model.rigs)
        for component in components:
            component.before(self)
        others = {name: group for c in components for name, group in c.parameters().items()}
        self.descent = Descent(
            self.model, others, settings.schedule, self._loss_of_features, self.epoch
        )
        for component in components:
            component.begin(self)

    @property
    def shared_steps(self) -> int:
        """See `IterativeFit`."""
        return self.settings.schedule.texture_every

    @property
    def batch(self) -> int:
        """Frames in each step."""
        # The authors give each process as many frames as there are hands.
        return self.settings.schedule.batch or len(self.data.training.sides) * self.world.size

    @property
    def epoch(self) -> float:
        """Steps that look at as many frames as there are."""
        return len(self.data.frames) / self.batch

    def part(self, kind: type[Kind]) -> Kind | None:
        """The component of a kind; None where it is left out."""
        return next((each for each in self.components if isinstance(each, kind)), None)

    def count_steps(self, budget: Budget) -> int:
        """See `IterativeFit`."""
        schedule = self.settings.schedule
        if budget.steps is not None:
            return budget.steps
        return math.ceil(schedule.epochs * self.epoch) if schedule.epochs else schedule.steps

    def batches(self) -> Iterator[Tensor]:
        """See `IterativeFit`: (B,) int64 each."""
        return batches(len(self.data.frames), self.batch, self.seed)

    def step(self, batch: Tensor, fraction: float) -> Loss:
        """Take one step on a batch, of which each process draws its part.

        Off the CPU nobody waits for the device: the step is queued.

        Args:
            batch: (B,) int64, which of the training frames; the same in every process, on the CPU.
            fraction: share of the budget that is used up.

        Returns:
            The loss without the reward of weights, which may bring it below 0; the same in every
            process. Nothing is changed where it is not finite.

        Raises:
            UsageError: the processes cannot share the batch evenly.
            PeerLost: another process has ended.
        """
        self.descent.set_rates(fraction)
        mine = StepBatch(batch, self.world.shard(len(batch)), stepping=True)
        loss, reward = self._loss_and_reward(mine)
        told = loss.detach() + self.descent.shared.value
        mean = self.world.average_(told if reward is None else told - reward.detach())
        known: Loss = float(mean) if self.device.type == "cpu" else mean
        if isinstance(known, float) and not math.isfinite(known):
            return known
        self.descent.take(loss, mean, self.world)
        return known

    def loss(self, batch: StepBatch) -> Tensor:
        """The loss of this process's part of a batch, without the terms that no frame enters."""
        return self._loss_and_reward(batch)[0]

    def _loss_and_reward(self, batch: StepBatch) -> tuple[Tensor, Tensor | None]:
        drawing = self.draw(batch)
        target = self.compare(batch, drawing)
        terms = (t for c in self.components for t in c.loss(self, batch, drawing, target))
        total = next(terms)
        for term in terms:
            total = total + term
        return total, target.reward

    def draw(self, batch: StepBatch, **options: Any) -> RenderedFrames:
        """Draw training frames with everything that is particular to them."""
        chosen: dict[str, Any] = {"dark": {}}
        for component in self.components:
            chosen.update(component.draws(self, batch))
        if batch.stepping:
            chosen["features"] = self.descent.shared.features()
        return self.model.draw_frames(
            self.clip,
            upload(batch.mine, self.device),
            self.data.training.width,
            self.data.training.height,
            refine=self.settings.heads,
            **chosen | options,
        )

    def compare(self, batch: StepBatch, drawing: RenderedFrames) -> FrameTarget:
        """The images that a drawing is compared with, and the weights of their pixels."""
        mine, data = batch.mine, self.data
        target = FrameTarget(
            data.images(mine), data.masks(mine), torch.ones((), device=self.device)
        )
        for component in self.components:
            target = component.compare(self, batch, drawing, target)
        return target

    def _loss_of_features(self, features: Features) -> Tensor | None:
        several = [each.loss_of_features(self, features) for each in self.components]
        found = [loss for loss in several if loss is not None]
        return sum(found[1:], found[0]) if found else None

    def finite(self) -> bool:
        """See `IterativeFit`."""
        return self.model.finite()

    def skipped(self) -> int:
        """See `IterativeFit`."""
        return int(self.descent.skipped)

    def snapshot(self) -> dict[str, Tensor]:
        """See `IterativeFit`."""
        return self.model.snapshot()

    def restore(self, values: dict[str, Tensor]) -> None:
        """See `IterativeFit`."""
        self.model.load_state_dict(values)
        for component in self.components:
            component.forget()

    def after_step(self) -> None:
        """See `IterativeFit`."""
        for component in self.components:
            component.after_step(self)

    def checkpoint(self, steps: int) -> Avatar:
        """See `IterativeFit`."""
        avatar: Avatar = self.avatar(steps)
        for component in self.components:
            avatar = component.checkpoint(avatar)
        return avatar

    def seconds_for_steps(self, seconds: float) -> float:
        """The part of a budget that is for steps: all but what `after` will take.

        Args:
            seconds: of the whole fit.
        """
        needed = sum(component.seconds(self) for component in self.components)
        return seconds - min(needed, MOST_OF_BUDGET * seconds)

    def seconds_now(self) -> float:
        """See `IterativeFit`."""
        return sum(component.seconds_now(self) for component in self.components)

    def finish(self, steps: int, seconds: float) -> WildGHandAvatar:
        """See `IterativeFit`. Of several processes, rank 0's has the record of the weights."""
        for component in self.components:
            component.after(self)
        return self.avatar(steps, seconds, final=self.world.is_main)

    def agree(self, fraction: float) -> float:
        """All processes follow the clock of rank 0, or some would stop a step before the others."""
        return self.world.broadcast(fraction)

    def tell(self, text: str) -> None:
        """See `IterativeFit`."""
        if self.world.is_main:
            super().tell(text)

    def require_same(self, step: int) -> None:
        """Check that all processes start from the same state."""
        if self.world.size == 1:
            return
        numbers = dict(self.model.state_dict())
        for component in self.components:
            for name, group in component.parameters().items():
                numbers |= {f"{name}.{index}": tensor for index, tensor in enumerate(group)}
        numbers |= {"clean": self.data.judgement.clean}
        numbers |= {"frames": torch.from_numpy(self.data.frames.indices)}
        self.world.require_same(digest_of(numbers, step))

    def avatar(self, steps: int, seconds: float = 0.0, *, final: bool = False) -> WildGHandAvatar:
        """The avatar as it stands; it keeps changing with the fit.

        Args:
            steps: optimizer steps behind it.
            seconds: of fitting.
            final: also tell what takes time: the temporal weights and the weight masks.
        """
        data = self.data
        fields: dict[str, Any] = {
            "frames": data.frames.indices.tolist(),
            "source": {"capture": data.training.id, "hands": self.given},
        }
        for component in self.components:
            for name, value in component.record(self, final=final).items():
                fields[name] = fields[name] | value if name == "source" else value
        return WildGHandAvatar(
            self.model,
            self.settings,
            data.training.hand_model,
            {side: data.training.hands[side].betas for side in self.model.rigs},
            data.mean_color,
            self.seed,
            FitRecord(**fields, steps=steps, seconds=seconds),
            self._weight_masks if final else dict,
        )

    @torch.no_grad()
    def _weight_masks(self) -> dict[int, np.ndarray]:
        """Weights of pixels in at most `MAX_MASKS` frames as (H, W) uint8, 255 = full weight."""
        pao, frames = self.settings.pao, self.data.frames.indices.tolist()
        masks: dict[int, np.ndarray] = {}
        if not pao.enabled:
            return masks
        # The paper's equations have no bound: 255 is the largest weight of a frame.
        least = 1e-12 if pao.variant in ("printed", "released") else 1.0
        for row in evenly(len(frames), MAX_MASKS).tolist():
            batch = StepBatch(torch.tensor([row]))
            weights = self.compare(batch, self.draw(batch)).weights[0]
            share = 255.0 * weights / weights.max().clamp(min=least)
            masks[frames[row]] = share.byte().cpu().numpy()
        return masks

    def component_states(self) -> dict[str, dict[str, Any]]:
        """The states of the components, by the names of their classes."""
        return {type(each).__name__: each.state_dict() for each in self.components}

    def load_component_states(self, states: Mapping[str, Mapping[str, Any]]) -> None:
        """Continue from saved states of the components."""
        for component in self.components:
            component.load_state_dict(states[type(component).__name__])

    def state_dict(self) -> dict[str, Any]:
        """Everything that steps change, for `load_state_dict`."""
        return {
            "model": self.model.state_dict(),
            "descent": self.descent.state_dict(),
            "components": self.component_states(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a saved state."""
        self.model.load_state_dict(state["model"])
        self.descent.load_state_dict(state["descent"])
        self.load_component_states(state["components"])
