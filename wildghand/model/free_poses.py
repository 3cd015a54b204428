"""One hand of the model in free poses, in two stages.

What network and light say comes first and takes longest. What evidence, changes of colours,
shadows and the refined pose make of it comes second, so that it can be tried in several ways.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

from torch import Tensor, nn

from wildghand.dpd.dpd import DynamicPerturbation, Perturbation, Temporal
from wildghand.evidence import ColorChanges, Evidence
from wildghand.gaussians.rig import AnchorPoses, HandRig
from wildghand.light import KnownLight
from wildghand.light.hand_shadows import Hand
from wildghand.model.dress import Gaussians, dress
from wildghand.model.relight import relit
from wildghand.network import HandFeatures, NetworkOutput, PredictionNetwork


class HandModel(Protocol):
    """The parts of `wildghand.model.model.WildGHandModel` that draw free poses; see there."""

    rigs: dict[str, HandRig]
    network: PredictionNetwork
    light: KnownLight | None
    evidence: Evidence | None
    color_changes: ColorChanges | None
    perturbation: nn.ModuleDict
    log_gains: nn.Parameter

    def predict(
        self, side: str, anchors: AnchorPoses, pose: Tensor, features: HandFeatures | None = None
    ) -> NetworkOutput:
        """Predict the attributes of one hand."""

    def shaded(self, prediction: NetworkOutput, normals: Tensor) -> NetworkOutput:
        """A prediction in the light that casts shadows."""

    def biases_of(self, side: str) -> DynamicPerturbation:
        """The perturbation module of one hand."""

    def perturbation_in(
        self, side: str, temporal: Temporal, anchors: AnchorPoses, kept: Tensor | None
    ) -> Perturbation:
        """The perturbation of one hand in B frames."""


@dataclass(frozen=True, eq=False)
class HandPrediction:
    """One hand in B free poses, after the first stage."""

    #: Pose (B, 16, 3), betas (10,) and translation (B, 3).
    hand: Hand
    #: In these poses.
    anchors: AnchorPoses
    #: Of the network, and of the light where the network knows no colours.
    prediction: NetworkOutput


def predict_hand(
    model: HandModel,
    side: str,
    hand: Hand,
    viewmats: Tensor | None,
    features: HandFeatures | None = None,
) -> HandPrediction:
    """What network and light say of one hand.

    Args:
        model: that draws it.
        side: which hand.
        hand: pose (B, 16, 3), betas (10,) and translation (B, 3).
        viewmats: (B, 4, 4) of the cameras that look at it; None: the light says nothing.
        features: of the network, where they are at hand already.
    """
    pose = hand[0]
    anchors = model.rigs[side].pose(*hand)
    features = model.network.features(side) if features is None else features
    prediction = model.predict(side, anchors, pose, features)
    if model.light is not None and viewmats is not None:
        prediction = relit(
            prediction,
            model.light,
            lambda normals: model.shaded(model.network(side, normals, pose, features), normals),
            anchors,
            viewmats,
        )
    return HandPrediction(hand, anchors, prediction)


def dressed(
    model: HandModel,
    side: str,
    predicted: HandPrediction,
    *,
    refine: bool = False,
    rows: Tensor | None = None,
    dark: Tensor | None = None,
) -> tuple[Gaussians, Hand]:
    """The Gaussians of one hand.

    Args:
        model: that draws it.
        side: which hand.
        predicted: of it, by `predict_hand`.
        refine: apply the network's refinement of the parameters (head iv).
        rows: (B,) positions among the training frames, whose biases and gains are added; None: free
            of perturbations.
        dark: (B, N) factors of the hands' shadows; None: ones.

    Returns:
        The Gaussians, and the parameters that they are posed by: the given or the refined ones.
    """
    rig, anchors, prediction = model.rigs[side], predicted.anchors, predicted.prediction
    pose, betas, transl = predicted.hand
    if model.evidence is not None:
        bias = model.network.activation.log_scale_bias
        settled = model.evidence.settle(side, prediction.raw, rig.spacing, bias)
        prediction = replace(prediction, raw=settled)
    if model.color_changes is not None:
        prediction = replace(prediction, raw=model.color_changes.color(side, prediction.raw))
    prediction = dimmed(prediction, dark)
    if refine:
        step = prediction.refinement
        pose, betas, transl = pose + step.pose, betas + step.betas, transl + step.transl
        anchors = rig.follow(pose, betas, transl)
    hand = pose, betas, transl
    if rows is None:
        return dress(anchors, prediction, model.network.activation)[0], hand
    perturbation = None
    if side in model.perturbation:
        temporal = model.biases_of(side).temporal(rows)
        perturbation = model.perturbation_in(side, temporal, anchors, None)
    made = dress(anchors, prediction, model.network.activation, perturbation)[0]
    return replace(made, colors=made.colors * model.log_gains[rows].exp()[:, None]), hand


def dimmed(prediction: NetworkOutput, dark: Tensor | None) -> NetworkOutput:
    """A prediction whose colours are multiplied by (B, N) factors; None: as it is."""
    if dark is None:
        return prediction
    return replace(prediction, shadow=prediction.shadow * dark[..., None])
