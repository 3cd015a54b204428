"""The components of a fit: the list that the settings make. A switch leaves one out of it."""

from __future__ import annotations

import torch

from hwp_bench.methods.contract import TrainingCapture
from wildghand.fitting.choice import AveragedSteps, StateChoice, ValidationFrames
from wildghand.fitting.colors import StartColors
from wildghand.fitting.disentangle import Dpd
from wildghand.fitting.fit import Component, Fit
from wildghand.fitting.judging import HandMasks, HiddenSkin, Prepass
from wildghand.fitting.light import Lighting
from wildghand.fitting.objective import Reconstruction, Regularisers
from wildghand.fitting.parallel import SINGLE_PROCESS, World
from wildghand.fitting.start import Person, Poses, StartFromPrior
from wildghand.fitting.visibility import FewShown
from wildghand.fitting.weights import MaskWeights, Pao
from wildghand.model.settings import WildGHandSettings


def components_of(settings: WildGHandSettings) -> list[Component]:
    """The components of a fit, in the order in which their hooks are called.

    Hands and frames are corrected and judged first; then come the mean and the choice of the steps,
    as light and colours are found for the state that a fit ends with, and the parts of the loss.
    """
    pao, visibility = settings.pao, settings.visibility
    chosen = settings.schedule.validated or visibility.enabled
    listed: list[tuple[bool, type[Component]]] = [
        (settings.poses.enabled, Poses),
        (settings.subject.enabled, Person),
        (settings.prepass.enabled, Prepass),
        (pao.hand != "estimated", HandMasks),
        (bool(settings.prior), StartFromPrior),
        (chosen, ValidationFrames),
        (True, AveragedSteps),
        (settings.schedule.validated, StateChoice),
        (settings.shadows.enabled or settings.light.enabled, Lighting),
        (settings.start_colors, StartColors),
        (settings.terms.leave_hidden, HiddenSkin),
        (True, Reconstruction),
        (True, Pao if pao.by_regions else MaskWeights),
        (True, Regularisers),
        (settings.dpd.enabled, Dpd),
        (visibility.enabled, FewShown),
    ]
    return [kind() for wanted, kind in listed if wanted]


def make_fit(
    training: TrainingCapture,
    settings: WildGHandSettings,
    seed: int,
    device: torch.device,
    world: World = SINGLE_PROCESS,
) -> Fit:
    """The fit of a capture with the components that its settings ask for; see `Fit`."""
    return Fit(training, settings, seed, device, world, components_of(settings))
