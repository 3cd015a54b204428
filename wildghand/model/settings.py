"""Settings of WildGHand: what is fitted, how, and for how long."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from hwp_bench.base.errors import BadMethod, HwpError
from hwp_bench.methods.settings import choice, number, settings_from
from wildghand.model.terms import PAPER_TERMS, TermWeights
from wildghand.network.settings import NetworkSettings, network_settings
from wildghand.pao.pao import PaoSettings
from wildghand.prepass import PrepassSettings

#: Where messages place a wrong setting.
WHERE = "wildghand"


@dataclass(frozen=True)
class Rates:
    """Adam's step for each group of parameters at the start of a fit."""

    #: The latent identity map.
    identity: float = number(0.03)
    #: The matrix that adds the map to the attributes.
    direct: float = number(1e-3)
    #: The linear part of the shadow head.
    light: float = number(0.01)
    #: Head iv.
    refinement: float = number(1e-3)
    #: The other layers of the network.
    network: float = number(0.01)
    #: DPD.
    dpd: float = number(1e-3)
    #: Thresholds of PAO.
    thresholds: float = number(1e-6)
    #: Log gain of each frame.
    gains: float = number(0.01)
    #: Pose of each frame, rad.
    pose: float = number(5e-4)
    #: Translation of each frame, m.
    transl: float = number(5e-5)


@dataclass(frozen=True)
class WildGHandSettings:
    """How an avatar is fitted; the defaults are those of the preset `default`."""

    #: `default`: what measurements keep. `paper`: the formulas as printed, made well-posed; the
    #: additions below are then off whatever they say.
    mode: str = choice("default", "paper")
    #: The prior over subjects that the network starts from. `shipped`: that of this package, where
    #: it is of the fit's network and hand model, and in the mode `default` alone. Empty: random
    #: weights. Else a folder made by `wildghand pretrain`, in either mode: a relative path is one
    #: within this package.
    prior: str = "shipped"
    #: Gaussians on each hand.
    gaussians: int = number(12_337, 1, 1_000_000)
    #: Optimiser steps unless the budget says otherwise.
    steps: int = number(2_000, 1, 10_000_000)
    #: Frames in each step.
    batch: int = number(1, 1, 64)
    #: Component: dynamic perturbation disentanglement.
    dpd: bool = True
    #: Component: perturbation-aware optimization.
    pao: bool = True
    #: Component: heads iii and iv, template offsets and refinement of the hand parameters.
    heads: bool = True
    #: Part of the heads: head iv acts; without it the given hand parameters stand.
    refinement: bool = True
    #: Alternative to PAO's weights: the hand's binary mask.
    binary_mask: bool = False
    #: Addition: judge the frames before the fit.
    prepass: bool = True
    #: Addition to DPD: a gain of each frame's colours, held near that of clean frames.
    gains: bool = True
    #: Addition to PAO: robust weights of residuals later in the fit, in place of the pre-pass's
    #: pixel weights. Off: where it was measured it cost more than it brought (docs/wildghand.md).
    robust: bool = False
    #: Addition to the heads: refine the pose of frames whose mask disagrees with it.
    frame_poses: bool = True
    #: Chance that a frame's biases are left out of a step (of a clean frame's, with `prepass`).
    omega_dropout: float = number(0.3, 0.0, 1.0)
    #: Addition to DPD: temporal weight that a frame which the pre-pass finds perturbed starts at
    #: and is held near. 0: all start at 0, and only those of clean frames are held there.
    omega_scale: float = number(0.05, 0.0, 0.9)
    #: Weight of the squared distance of the temporal weights from what the pre-pass says.
    omega_weight: float = number(1.0)
    #: Share of D-SSIM in the reconstruction loss; the rest is L1.
    dssim_weight: float = number(0.2, 0.0, 1.0)
    #: Weight of a pixel outside the visible-hand mask, beside 1 inside.
    outside_weight: float = number(0.03, 0.0, 1.0)
    #: Share of the budget after which residuals decide the weights.
    robust_start: float = number(0.25, 0.0, 1.0)
    #: Weight of the square of the log gains, for a frame that is surely clean.
    gain_weight: float = number(0.1)
    #: Norm that the gradient is clipped to; 0 leaves it as it is.
    clip_gradient: float = number(1.0)
    #: `geometric`: steps fall smoothly to `final_rate`; `halving`: by half, `halvings` times.
    decay: str = choice("geometric", "halving")
    #: Size of the steps at the end of the budget, as a share of that at its start.
    final_rate: float = number(0.05, 1e-6, 1.0)
    #: How often `halving` halves.
    halvings: int = number(10, 0, 100)
    #: Stop when the loss has not fallen by 0.1 % over this many steps; 0 never stops early.
    plateau_steps: int = number(0, 0, 10_000_000)
    #: Mixed precision of the network; CUDA only.
    mixed_precision: bool = False
    #: `auto` (CUDA where both a GPU and gsplat are there), `cpu` or `cuda`.
    device: str = choice("auto", "cpu", "cuda")
    #: Adam's steps.
    rates: Rates = field(default_factory=Rates)
    #: The network.
    network: NetworkSettings = field(default_factory=NetworkSettings)
    #: Weights of PAO.
    weights: PaoSettings = field(default_factory=PaoSettings)
    #: Weights of the regularisers.
    terms: TermWeights = field(default_factory=TermWeights)
    #: The judge of the frames. It leaves the biases out of every clean frame, not out of three in
    #: ten: what little they took from these, the avatar lacked (docs/wildghand.md).
    judge: PrepassSettings = field(
        default_factory=lambda: PrepassSettings(weight_floor=0.02, omega_dropout=1.0)
    )

    @property
    def additions(self) -> bool:
        """Whether anything beyond the paper may be on."""
        return self.mode == "default"

    @property
    def judges(self) -> bool:
        """Whether the frames are judged before the fit."""
        return self.additions and self.prepass and (self.dpd or self.pao)

    @property
    def weighs_frames(self) -> bool:
        """Whether the judgement lowers the weights of frames and pixels."""
        return self.pao and not self.binary_mask

    @property
    def uses_regions(self) -> bool:
        """Whether frames are cut into regions."""
        return self.pao and not self.binary_mask and (self.robust or not self.additions)

    @property
    def uses_gains(self) -> bool:
        """Whether each frame has a gain of its colours."""
        return self.additions and self.dpd and self.gains

    @property
    def holds_omega(self) -> bool:
        """Whether temporal weights are held near what the pre-pass says."""
        return self.judges and self.dpd

    @property
    def moves_poses(self) -> bool:
        """Whether frames have corrections of their pose."""
        return self.additions and self.heads and self.frame_poses

    @property
    def refines(self) -> bool:
        """Whether head (iv) acts."""
        return self.heads and self.refinement

    @property
    def term_weights(self) -> TermWeights:
        """The terms' weights of the mode."""
        return self.terms if self.additions else PAPER_TERMS

    def weights_of(self, hands: int) -> PaoSettings:
        """PAO's settings for one hand or two: the paper's background threshold differs."""
        if hands > 1 and self.weights == PaoSettings():
            return dataclasses.replace(self.weights, background_threshold=10.0)
        return self.weights


def read_settings(values: Mapping[str, Any]) -> WildGHandSettings:
    """Check a preset's table with its overrides.

    Args:
        values: any of the fields of `WildGHandSettings`; tables for those that are tables, or
            `name.field`. `network.size` chooses the network, its other fields change it.

    Raises:
        BadMethod: an unknown name, a wrong type, or a value outside its range.
    """
    rest, changes = {}, {}
    for name, value in values.items():
        head, dot, tail = name.partition(".")
        if head != "network":
            rest[name] = value
        elif dot:
            changes[tail] = value
        elif isinstance(value, Mapping):
            changes.update(value)
        else:
            raise BadMethod("must be a table", where=WHERE, field="network")
    settings = settings_from(WildGHandSettings, rest, WHERE)
    try:
        network = network_settings(**changes)
    except HwpError as error:
        raise BadMethod(str(error), where=WHERE, field="network") from error
    return dataclasses.replace(settings, network=network)
