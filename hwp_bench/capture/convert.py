"""Convert the parameters of one hand model to another by fitting; give a clip one shape."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np
import torch

from hwp_bench.base.errors import ShapeMismatch, UsageError
from hwp_bench.capture.reader import Capture, identify_hand_model
from hwp_bench.capture.writer import rewrite_capture
from hwp_bench.hands.fitting import FitTargets, FittedHand, FittingSettings, fit_hand
from hwp_bench.hands.parameters import HandParameters
from hwp_bench.hands.skinning import pose_hand
from hwp_bench.hands.template import HandTemplate
from hwp_bench.hands.template_sources import load_template

#: Points of the source's skin that the target is fitted to.
SKIN_POINTS = 320


@dataclass(frozen=True)
class ConversionError:
    """The error of a conversion, over the valid frames of one hand."""

    #: Mean distance of the 21 landmarks, mm. Models put joints in different places in the flesh,
    #: so some of it is not an error.
    landmark_mm: float
    #: Mean distance of the source's skin from the target's, mm.
    skin_mm: float
    #: Largest of the frames' mean skin distances, mm.
    worst_skin_mm: float


def convert_hand(
    hand: HandParameters,
    source: HandTemplate,
    target: HandTemplate,
    settings: FittingSettings | None = None,
) -> tuple[HandParameters, ConversionError]:
    """Express a hand in another hand model.

    Args:
        hand: parameters that belong to `source`.
        source: the hand model that they are given in.
        target: the hand model to convert to, of the same side.
        settings: steps and weights of the fit.

    Returns:
        Parameters that belong to `target`, and how far they are from the source's hand.

    Raises:
        UsageError: the templates are of different sides.
        BadInput: no frame is valid.
    """
    if source.side != target.side:
        raise UsageError(f"a {source.side} hand is not a {target.side} hand", field="target")
    tensors = source.to_torch(torch.float64)
    with torch.no_grad():
        posed = pose_hand(tensors, *_tensors(hand))
    # Both wrists in the same place; the joints' axes agree between the models.
    with torch.no_grad():
        other = pose_hand(target.to_torch(torch.float64), *_tensors(_unshaped(hand)))
    shift = (posed.joints[:, 0] - other.joints[:, 0]).numpy()
    start = replace(_unshaped(hand), transl=hand.transl + shift)
    step = max(1, len(source.vertices) // SKIN_POINTS)
    targets = FitTargets(posed.landmarks.numpy(), skin=posed.vertices[:, ::step].numpy())
    fitted = fit_hand(target, targets, start, settings)
    return fitted.parameters, conversion_error(fitted)


def conversion_error(fitted: FittedHand) -> ConversionError:
    """Average a fit's errors over the valid frames."""
    return ConversionError(
        landmark_mm=float(np.nanmean(fitted.landmark_mm)),
        skin_mm=float(np.nanmean(fitted.skin_mm)),
        worst_skin_mm=float(np.nanmax(fitted.skin_mm)),
    )


def with_one_shape(
    template: HandTemplate,
    pose: np.ndarray,
    betas: np.ndarray,
    transl: np.ndarray,
    valid: np.ndarray,
) -> tuple[HandParameters, np.ndarray]:
    """Give all frames the median shape, and move each so that its vertices stay in place.

    Args:
        template: the hand model.
        pose: (F, 16, 3) axis-angle rad, the pose itself (no mean pose to be added).
        betas: (F, 10), one for each frame, as per-frame estimators give them.
        transl: (F, 3) m.
        valid: (F,) bool.

    Returns:
        Parameters with one shape, and (F,) the mean distance of the vertices from where the
        frame's own shape has them, mm; NaN where not valid.

    Raises:
        ShapeMismatch: the arrays do not describe the same frames.
    """
    if betas.shape != (len(pose), 10):
        raise ShapeMismatch(f"shape is {betas.shape}, expected ({len(pose)}, 10)", field="betas")
    common = np.median(betas[valid], axis=0) if valid.any() else np.zeros(10)
    clean = [
        np.where(valid.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0) for a in (pose, betas, transl)
    ]
    tensors = template.to_torch(torch.float64)
    with torch.no_grad():
        own = pose_hand(tensors, *map(torch.from_numpy, clean)).vertices
        shared = pose_hand(
            tensors,
            torch.from_numpy(clean[0]),
            torch.from_numpy(common),
            torch.from_numpy(clean[2]),
        ).vertices
    shift = (own - shared).mean(dim=1)
    error = 1000.0 * (own - shared - shift[:, None]).norm(dim=-1).mean(dim=1).numpy()
    hand = HandParameters(clean[0], common, clean[2] + shift.numpy(), valid)
    return hand, np.where(valid, error, np.nan)


def convert_capture(
    capture: Capture,
    out: str | os.PathLike[str],
    source: str,
    *,
    overwrite: bool = False,
    settings: FittingSettings | None = None,
) -> dict[str, ConversionError]:
    """Write a capture again with its hands in another hand model; images stay as they are.

    Args:
        capture: the capture.
        out: the capture folder to make.
        source: the model to convert to, as `load_template` takes it.
        overwrite: replace an existing folder.
        settings: steps and weights of the fit.

    Returns:
        The error of the conversion, by side.

    Raises:
        UsageError: `out` exists, or the hand model does not exist.
        BadHandModel: the template that the capture names cannot be loaded.
        BadInput: the template that is loaded is not the capture's.
    """
    info = capture.info
    made, errors = {}, {}
    for side, hand in capture.hands.items():
        target = load_template(source, side)
        made[side], errors[side] = convert_hand(hand, capture.template(side), target, settings)
    note = {side: vars(error) for side, error in errors.items()}
    changed = replace(
        info,
        hand_model=identify_hand_model(source, info.hands),
        source={**info.source, "converted": {"from": info.hand_model.name, "error": note}},
    )
    rewrite_capture(capture, out, changed, made, overwrite=overwrite)
    return errors


def _unshaped(hand: HandParameters) -> HandParameters:
    return replace(hand, betas=np.zeros(10))


def _tensors(hand: HandParameters) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return torch.from_numpy(hand.pose), torch.from_numpy(hand.betas), torch.from_numpy(hand.transl)
