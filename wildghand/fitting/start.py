"""The start of a fit: corrected poses, the person's hand, and the prior."""

from __future__ import annotations

from typing import Any

import numpy as np

from hwp_bench.methods.request import frames_of_true_poses
from wildghand.fitting.data import FitData
from wildghand.fitting.fit import Component, Fit
from wildghand.gaussians.training import TrainingFrames
from wildghand.poses import ClipPoses, believed_hands
from wildghand.prior.prior import choose_prior
from wildghand.subject import SubjectShape, fit_subject
from wildghand.subject.outlines import ComparedFrames


class Poses(Component):
    """The given poses of a capture are corrected, those of the frames to predict too."""

    def __init__(self) -> None:
        #: So that an avatar draws the same hands where it is given the capture's; None where
        #: nothing was corrected.
        self.remembered: ClipPoses | None = None

    def prepare(self, fit: Fit) -> None:
        """Replace the capture by one with corrected hands."""
        training, templates = fit.data.training, fit.data.templates
        # An error budget gives true poses in some frames.
        exact = frames_of_true_poses(training.split, training.run.frames)
        believed = believed_hands(templates, training.hands, training.cameras, exact)
        self.remembered = ClipPoses.of(training.hands, believed)
        if self.remembered is not None:
            fit.data.training = training.with_hands(believed)
            rows = training.train
            fit.data.exact_poses = all(
                np.array_equal(hand.pose[rows], given.pose[rows])
                and np.array_equal(hand.transl[rows], given.transl[rows])
                for hand, given in ((believed[side], training.hands[side]) for side in believed)
            )

    def before(self, fit: Fit) -> None:
        """Let the model keep the corrected poses."""
        if self.remembered is not None:
            fit.model.keep(self.remembered)


class Person(Component):
    """The templates are bent to the masks, so that frames are compared with the person.

    Validation frames choose how far.
    """

    def prepare(self, fit: Fit) -> None:
        """Find how the person's hand differs from the templates."""
        fit.data.subject = find_person(fit.data, fit.data.judges)


def find_person(data: FitData, judges: TrainingFrames | None) -> SubjectShape:
    """How a person's hand differs from the templates, chosen by `judges` where there are any."""
    training, frames = data.training, data.frames

    def compared(some: TrainingFrames) -> ComparedFrames:
        masks = np.asarray(some.masks) > 127
        return ComparedFrames(data.templates, training.hands, training.cameras, some.indices, masks)

    return fit_subject(
        data.templates,
        training.hands,
        training.cameras,
        frames.indices,
        np.asarray(frames.masks),
        judges=None if judges is None else compared(judges),
    )


class StartFromPrior(Component):
    """The network starts from a prior over subjects in place of random weights.

    Raises:
        BadInput: the prior is damaged or of another kind.
    """

    def __init__(self) -> None:
        self._source: dict[str, str] = {}

    def before(self, fit: Fit) -> None:
        """Replace the network's weights by the prior's."""
        network = fit.model.network
        prior = choose_prior(fit.settings, fit.data.training.hand_model, network)
        if prior is not None:
            prior.initialise(network)
            self._source = {"prior": prior.record.weights}
        elif fit.settings.network.size == "paper":
            fit.tell("No prior of the paper's network is there: it starts from random weights.")

    def record(self, fit: Fit, *, final: bool) -> dict[str, Any]:
        """The digest of the prior's weights."""
        return {"source": self._source}
