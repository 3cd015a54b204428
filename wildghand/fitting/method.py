"""WildGHand as an entry of the benchmark, and what is made ready before a fit's clock starts."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hwp_bench.base.errors import BadMethod
from hwp_bench.hands.raster import draw_faces, mix_corners
from hwp_bench.methods.contents import exposed_digest
from hwp_bench.methods.contract import Budget, Report, TrainingCapture
from hwp_bench.methods.settings import source_path
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.dpd.dpd import DynamicPerturbation, FramePerturbation
from wildghand.fitting.components import make_fit
from wildghand.fitting.objective import refuse_idle_network
from wildghand.gaussians.attributes import CHANNELS, Activation, RawAttributes
from wildghand.gaussians.fit_loop import ready_device
from wildghand.gaussians.perceptual import Vgg19
from wildghand.gaussians.rig import AnchorPoses
from wildghand.light import Obstacles
from wildghand.model.dress import dress
from wildghand.model.settings import WildGHandSettings, read_settings
from wildghand.network import NetworkOutput, Refinement
from wildghand.pao.sam import check_checkpoint
from wildghand.plain.loop import run_fit
from wildghand.prior.prior import SHIPPED, find_prior
from wildghand.splat.threads import denormals_flushed

# Training frames that a budget has room for at least: fewer say too little of a person.
_LEAST = 16


class WildGHandMethod:
    """See `hwp_bench.methods.contract.Method`.

    Args:
        settings: any of the fields of `wildghand.model.settings.WildGHandSettings`.
        seed: of anchors, initial weights, order of the frames and dropout; on one machine's CPU
            the same seed and number of steps give the same avatar bit for bit.

    Raises:
        BadMethod: a setting is unknown or out of range.
        BadInput: a file that settings name is missing or unusable.
        UsageError: a perceptual network is named whose term has no weight.
        MissingDependency: CUDA was asked for and is not there.
    """

    def __init__(self, settings: Mapping[str, Any], seed: int = 0) -> None:
        self.settings = read_usable(settings)
        self.seed = seed
        self.device = ready_fit(self.settings.device)

    @denormals_flushed()
    def fit(self, training: TrainingCapture, budget: Budget, report: Report) -> WildGHandAvatar:
        """Fit an avatar to the training frames (validation frames only choose what training frames
        cannot decide; see `wildghand.fitting.choice`).

        Args:
            training: what the method may see of the capture.
            budget: when to stop; without steps the settings' number holds.
            report: where checkpoints are offered.

        Raises:
            BadInput: no training frame can be used.
            DidNotConverge: the fit diverged at once.
        """
        training = affordable(training, self.settings, budget)
        return run_fit(make_fit(training, self.settings, self.seed, self.device), budget, report)


class NetworkMethod(WildGHandMethod):
    """The network from random weights; refuses what its `method.toml` says that it does not use."""

    def __init__(self, settings: Mapping[str, Any], seed: int = 0) -> None:
        super().__init__(settings, seed)
        made = self.settings
        used = {
            "prior": bool(made.prior),
            "prepass.enabled": made.prepass.enabled,
            "subject.enabled": made.subject.enabled,
            "visibility.enabled": made.visibility.enabled,
        }
        for name in (name for name, value in used.items() if value):
            raise BadMethod(
                "is not a part of this method, which declares that it was trained on nothing and "
                "chooses an earlier state alone by validation frames",
                where="network-scratch",
                field=name,
                remedy="Take the method wildghand, and leave out of it what you do not want.",
            )


def affordable(
    training: TrainingCapture, settings: WildGHandSettings, budget: Budget
) -> TrainingCapture:
    """Leave training frames out where judging all of them would take the budget away from steps.

    Before the first step every frame is loaded, judged, compared with the person's outline and
    counted: some 0.06 seconds for a frame of 256 px on one core. A clip of a thousand
    frames would spend a minute on that.
    """
    share = settings.schedule.frames_per_second
    if budget.seconds is None or not share:
        return training
    return training.thinned(max(_LEAST, int(share * budget.seconds)))


def digest_of_named_files(settings: WildGHandSettings) -> str:
    """SHA-256 (hex) of the content of the files that settings name: the prior, and networks."""
    sources = (settings.pao.regions, settings.pao.hand, settings.perceptual)
    paths = [Path(path) for path in map(source_path, sources) if path is not None]
    if settings.prior not in ("", SHIPPED):
        paths.append(find_prior(settings.prior))
    return exposed_digest(paths)


def read_usable(values: Mapping[str, Any]) -> WildGHandSettings:
    """Read settings; check the files that they name: a prior's place, networks' tensors."""
    settings = read_settings(values)
    refuse_idle_network(settings)
    if settings.prior not in ("", SHIPPED):
        find_prior(settings.prior)
    for path in {source_path(settings.pao.regions), source_path(settings.pao.hand)} - {None}:
        check_checkpoint(str(path))
    perceptual = source_path(settings.perceptual)
    if perceptual is not None:
        Vgg19(perceptual)  # as light as a check: its tensors stay on the disk
    return settings


def ready_fit(name: str) -> torch.device:
    """Choose the device of a fit, and compile or load for it what the fit needs."""
    device = ready_device(name)
    if device.type == "cpu":
        _warm_up()
    return device


@functools.cache
def _warm_up() -> None:
    """Run every kernel of the model, both ways, on one Gaussian."""
    zeros = torch.zeros
    anchors = AnchorPoses(zeros(1, 1, 3), zeros(1, 1, 4))
    with torch.random.fork_rng(devices=[]):
        module = DynamicPerturbation(1, 1)
    prediction = NetworkOutput(
        RawAttributes.split(zeros(1, 1, CHANNELS)),
        zeros(1, 1, 1),
        zeros(1, 3),
        Refinement(zeros(1, 16, 3), zeros(10), zeros(1, 3)),
        zeros(1, 1),
    )
    perturbation = FramePerturbation(module, module.temporal(torch.tensor([0])))
    gaussians, size = dress(anchors, prediction, Activation(), perturbation, torch.ones(1))
    assert size is not None
    (gaussians.means.sum() + size).backward()
    # Shadows are cast by rays.
    corner = np.eye(3)
    Obstacles([(corner, np.array([[0, 1, 2]]))]).free(corner, corner, corner)
    # The pre-pass draws the hands.
    faces = np.zeros((1, 3), np.int64)
    face, mix = draw_faces(np.zeros((1, 2)), np.zeros(1), faces, (1, 1))
    mix_corners(np.zeros((1, 1)), faces, face.reshape(-1)[:0], mix.reshape(-1, 2)[:0])
