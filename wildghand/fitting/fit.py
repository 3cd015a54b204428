"""A fit: how it is made from a capture, everything that changes from step to step, and one step."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from hwp_bench.capture.schema import HandModelId
from hwp_bench.methods.contract import TrainingCapture
from wildghand.avatar.avatar import FitRecord, WildGHandAvatar
from wildghand.dpd.dpd import draw_kept
from wildghand.dpd.temporal_loss import TemporalTarget
from wildghand.evidence import shown_frames, weigh_evidence
from wildghand.fitting.averaging import StepAverage
from wildghand.fitting.believed_poses import in_believed_poses
from wildghand.fitting.borrowed_colors import BorrowedColors
from wildghand.fitting.cast_shadows import cast_shadows, shadows_in
from wildghand.fitting.closing import MOST_OF_BUDGET, LightFit, weight_masks
from wildghand.fitting.evidence_choice import EvidenceChoice, Gaps
from wildghand.fitting.filled_colors import FilledColors
from wildghand.fitting.hand_masks import hand_masks
from wildghand.fitting.judged_drawings import JudgedDrawings
from wildghand.fitting.judging_frames import judging_frames
from wildghand.fitting.objective import Objective
from wildghand.fitting.parallel import SINGLE_PROCESS, World, average_gradients, digest_of
from wildghand.fitting.rates import make_optimizer, set_rates
from wildghand.fitting.shared_features import SharedFeatures
from wildghand.fitting.skin_places import skin_places
from wildghand.fitting.start_colors import start_from_colors
from wildghand.fitting.state_choice import StateChoice
from wildghand.fitting.subject_shape import bent_templates, subject_of
from wildghand.fitting.weighting import Weighting, assess_frames, needs_places
from wildghand.gaussians.fit_loop import Loss, repeatable
from wildghand.gaussians.frame_table import upload
from wildghand.gaussians.training import TrainingClip, load_frames
from wildghand.model.frames import RenderedFrames
from wildghand.model.model import WildGHandModel, make_model
from wildghand.model.settings import WildGHandSettings
from wildghand.network import HandFeatures
from wildghand.prior.prior import choose_prior


class Fit:
    """One fit of one capture.

    Args:
        training: what may be seen of the capture.
        settings: how.
        seed: of anchors, initial weights, order of the frames, and dropout.
        device: where it runs.
        world: the processes that share its batches.

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
        world: World = SINGLE_PROCESS,
    ) -> None:
        templates = {side: training.template(side) for side in training.sides}
        training, clip_poses = in_believed_poses(training, templates, settings.poses)
        self.training = training
        self.settings = settings
        self.seed = seed
        self.device = device
        self.world = world
        self.frames = load_frames(training)
        self.mean_color = self.frames.mean_color()
        judges = judging_frames(training, settings)
        subject = subject_of(training, self.frames, templates, settings, judges)
        self.model = make_model(
            templates, settings, self.mean_color, len(self.frames), seed, device, subject
        )
        self.model.network.mixed_precision = settings.mixed_precision and device.type == "cuda"
        if clip_poses is not None:
            self.model.keep(clip_poses)
        self.source = {"capture": training.id}
        self.source |= start_from_prior(self.model, settings, training.hand_model)
        self.clip = TrainingClip(training, self.frames.indices, self.model.rigs, device)
        # Frames are compared with the person, not with a template that fits none of them.
        bent = bent_templates(templates, subject)
        assessment = assess_frames(training, self.frames, bent, settings, judges)
        masks = hand_masks(training, self.frames, settings.pao.hand, device)
        self.frames = dataclasses.replace(self.frames, masks=masks)
        self.weighting = Weighting(
            self.frames,
            len(training.sides),
            assessment,
            settings,
            device,
            skin_places(training, self.frames, bent) if needs_places(settings) else (),
        )
        count, shown = len(self.frames), {}
        if settings.evidence.enabled:
            shown = shown_frames(self.model.rigs, self.clip, self.weighting.visible, count)
            self.model.keep(weigh_evidence(shown, count, settings.evidence))
        cast_shadows(self.model, self.clip, self.frames, self.weighting, settings.shadows, seed)
        #: The shadows in the training frames.
        self.dark = shadows_in(self.model, self.clip)
        if settings.start_colors:
            start_from_colors(self.model, self.clip, self.frames, self.weighting, self.dark)
        #: The colours that one of two hands takes from the other, which come last.
        self.borrowed = BorrowedColors.of(self.model, self.clip, self.weighting, settings.evidence)
        judged = JudgedDrawings.of(self.model, training, settings, judges)
        self.choice = EvidenceChoice(
            self.model,
            settings,
            shown,
            count,
            judged,
            FilledColors(self.model, self.borrowed, shown, count),
            Gaps(self.model, self.clip, self.weighting.visible, count),
        )
        temporal = begin_temporal_weights(self.model, self.weighting, settings)
        self.objective = Objective(settings, self.model.rigs, temporal, device)
        self.optimizer = make_optimizer(self.model, self.weighting.pao, settings)
        self.average = StepAverage.of_optimizer(self.optimizer, settings.schedule.average_share)
        #: Where the fit may go back to after its last step.
        self.state_choice = StateChoice.of(self.average, count, settings.schedule, judged)
        #: Steps behind it.
        self.steps = 0
        self.generator = torch.Generator().manual_seed(seed)
        self._record = FitRecord(
            frames=self.frames.indices.tolist(),
            clean=self.weighting.clean.tolist(),
            frame_weights=self.weighting.frame_weights.tolist(),
            source=dict(self.source),
        )
        self.shared = SharedFeatures(
            self.model.network, settings.schedule.texture_every, self.objective.of_features
        )

    def step(self, rows: torch.Tensor, fraction: float) -> Loss:
        """Take one step on a batch, of which each process draws its part.

        Off the CPU nobody waits for the device: the step is queued.

        Args:
            rows: (B,) int64, which of the training frames; the same in every process. On the CPU.
            fraction: share of the budget that is used up.

        Returns:
            The loss, the same in every process; nothing is changed where it is not finite.

        Raises:
            UsageError: the processes cannot share the batch evenly.
            PeerLost: another process has ended.
        """
        set_rates(self.optimizer, self.settings.schedule, fraction, self.steps)
        loss = self._loss(rows)
        mean = self.world.average_(loss.detach() + self.shared.value)
        known: Loss = float(mean) if self.device.type == "cpu" else mean
        if isinstance(known, float) and not math.isfinite(known):
            return known
        self.optimizer.clear()
        with repeatable(self.device):
            waiting = self.shared.backward(loss, mean)
        average_gradients(
            (tensor for group in self.optimizer.param_groups for tensor in group["params"]),
            self.world,
        )
        self.optimizer.take_step(waiting)
        self.steps += 1
        return known

    def _loss(self, rows: torch.Tensor) -> torch.Tensor:
        """The loss of this process's part of a batch, without the terms that no frame enters."""
        weighting, part = self.weighting, self.world.shard(len(rows))
        mine = rows[part]
        kept = {side: keep[part] for side, keep in self._keep(rows).items()}
        features = self.shared.features()
        drawing = self.draw(mine, kept, move=weighting.moves(rows), features=features)
        target = weighting(rows, drawing, self.world)
        return self.objective(self.model, drawing, target, mine, weighting.clean[mine])

    def require_same(self, step: int) -> None:
        """Check that all processes start from the same state.

        Args:
            step: steps behind it.

        Raises:
            HwpError: one does not.
        """
        if self.world.size == 1:
            return
        weighting = self.weighting
        numbers = {**self.model.state_dict(), **weighting.pao.state_dict()}
        numbers |= {"clean": weighting.clean, "dropped": weighting.drop_probability}
        numbers |= {"frames": torch.from_numpy(self.frames.indices)}
        self.world.require_same(digest_of(numbers, step))

    def state_dict(self) -> dict[str, Any]:
        """Everything that steps change, for `load_state_dict`."""
        return {
            "model": self.model.state_dict(),
            **self.weighting.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
            "shared": self.shared.state_dict(),
            "average": self.average.state_dict(),
            "earlier": self.state_choice.states.state_dict(),
            "steps": self.steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        self.model.load_state_dict(state["model"])
        self.weighting.load_state_dict(state)
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"].cpu())
        # States of before have none of these: their steps shared nothing, were not averaged, and
        # kept no earlier state.
        self.shared.load_state_dict(state.get("shared", {"steps": 0}))
        self.average.load_state_dict(state.get("average", {"steps": 0, "means": []}))
        if "earlier" in state:
            self.state_choice.states.load_state_dict(state["earlier"])
        self.steps = int(state.get("steps", 0))

    def _keep(self, rows: torch.Tensor) -> dict[str, torch.Tensor]:
        """(B,) bool by side: which frames of a batch keep their biases in this step."""
        chances = self.weighting.drop_probability[rows]
        return {
            side: upload(draw_kept(chances, self.generator), self.device)
            for side in self.model.perturbation
        }

    def draw(
        self,
        rows: torch.Tensor,
        kept: Mapping[str, torch.Tensor] | None = None,
        *,
        move: bool | None = None,
        features: Mapping[str, HandFeatures] | None = None,
    ) -> RenderedFrames:
        """Draw training frames with everything that is particular to them.

        Args:
            rows: (B,) int64, which of the training frames; on the CPU.
            kept: (B,) bool by side, whether a frame keeps its biases; None: every one does.
            move: refine the poses of the frames; None: if any of them needs it.
            features: of the network by side, where they are at hand already.
        """
        return self.model.draw_frames(
            self.clip,
            upload(rows, self.device),
            self.training.width,
            self.training.height,
            kept=kept,
            teach=functools.partial(self.weighting.shares, rows),
            move=self.weighting.moves(rows) if move is None else move,
            refine=self.settings.heads.refinement,
            features=features,
            dark=self.dark(rows),
        )

    @property
    def light(self) -> LightFit:
        """The fit of the clip's light, which comes last."""
        weights = self.weighting.frame_weights
        return LightFit(self.model, self.clip, weights, self.settings.light, self.seed)

    def seconds_for_steps(self, seconds: float) -> float:
        """Return the part of a budget that is for steps: all but what `finish` will take.

        Args:
            seconds: of the whole fit.
        """
        needed = self.light.seconds() + self.choice.seconds()
        return seconds - min(needed, MOST_OF_BUDGET * seconds)

    def finish(self) -> int | None:
        """Choose the state that the fit ends with, and find what follows from it.

        That is the light, colours that hands take from each other, how strongly evidence acts, and
        colours that places take from the skin around them.

        Returns:
            Steps behind the state, if it is an earlier one than the last.
        """
        chosen = self.state_choice.choose()
        for find in (self.light.learn, self.borrowed.learn):
            found = find()
            if found is not None:
                self.model.keep(found)
        for best in self.choice.best():
            self.model.keep(best)
        return chosen

    def avatar(
        self,
        steps: int,
        seconds: float = 0.0,
        *,
        chosen: int | None = None,
        final: bool = False,
    ) -> WildGHandAvatar:
        """The avatar as it stands; it goes on changing with the fit.

        Args:
            steps: optimizer steps behind it.
            seconds: of fitting.
            chosen: steps behind the state that is kept, if it is an earlier one.
            final: also record the temporal weights, and tell the weight masks.
        """
        hands = self.training.hands
        return WildGHandAvatar(
            self.model,
            self.settings,
            self.training.hand_model,
            {side: hands[side].betas for side in self.model.rigs},
            self.mean_color,
            self.seed,
            dataclasses.replace(
                self._record,
                temporal=self._temporal() if final else {},
                steps=steps,
                chosen_steps=chosen,
                seconds=seconds,
            ),
            self._weight_masks if final else dict,
        )

    def _weight_masks(self) -> dict[int, np.ndarray]:
        pao = self.settings.pao
        if not pao.enabled:
            return {}
        return weight_masks(
            self.frames.indices.tolist(),
            lambda rows: self.weighting(rows, self.draw(rows)).weights,
            unbounded=pao.variant == "printed",
        )

    @torch.no_grad()
    def _temporal(self) -> dict[str, list[float]]:
        rows = torch.arange(len(self.frames), device=self.device)
        return {
            side: self.model.biases_of(side).temporal(rows).omega.tolist()
            for side in self.model.perturbation
        }


def start_from_prior(
    model: WildGHandModel, settings: WildGHandSettings, hand_model: HandModelId
) -> dict[str, str]:
    """Put the prior's weights in place of the network's, where the settings have one.

    Returns:
        What an avatar says of it: the digest of the weights as `prior`, or nothing.

    Raises:
        BadInput: the prior is damaged or of another kind.
    """
    prior = choose_prior(settings, hand_model, model.network)
    if prior is None:
        return {}
    prior.initialise(model.network)
    return {"prior": prior.record.weights}


def begin_temporal_weights(
    model: WildGHandModel, weighting: Weighting, settings: WildGHandSettings
) -> TemporalTarget | None:
    """Bring temporal weights to what the pre-pass found; None without it or without DPD.

    Args:
        model: it is changed.
        weighting: knows what it found.
        settings: of the fit.
    """
    if not (settings.dpd.enabled and settings.prepass.enabled):
        return None
    device = model.log_gains.device
    temporal = TemporalTarget.judged(
        weighting.clean.to(device),
        weighting.frame_weights.to(device),
        settings.dpd.omega_scale,
        settings.prepass.weight_floor,
    )
    temporal.begin(model.biases)
    return temporal
