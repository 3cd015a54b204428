"""A."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import cv2
import numpy as np


@dataclass(frozen=True)
class PrepassSettings:
    """How training frames are judged; the defaults suit every capture."""

    #: Judge the frames before the fit.
    enabled: bool = True
    #: Refine the pose of frames whose mask disagrees with it.
    frame_poses: bool = True
    #: Edge of the cells that share one albedo, m on the rest surface.
    patch_size: float = 0.004
    #: Pixels of all frames together from which the intensity model is fitted.
    sample_count: int = 120_000
    #: Pixels of all frames together beyond which they are judged at a lower resolution.
    pixel_budget: int = 30_000_000
    #: Passes of the robust fit.
    iterations: int = 10
    #: Samples that the mean skin colour is worth in the albedo of a cell.
    albedo_prior: float = 3.0
    #: Share of the frames that is taken to be clean at least; the densest such part of a cue's
    #: values says what is normal.
    clean_share: float = 0.35
    #: Least log gain that counts as one deviation: what shading leaves unexplained.
    gain_floor: float = 0.08
    #: Least change of the log of the residual that does.
    residual_floor: float = 0.25
    #: Least loss of texture that does.
    texture_floor: float = 0.15
    #: Least change of the log of the border's width that does.
    border_floor: float = 0.15
    #: Least misplacement that does, share of the hand's size.
    misplacement_floor: float = 0.0006
    #: Least hidden share of the hand that does.
    hidden_floor: float = 0.02
    #: Evidence (`wildghand.prepass.judge.evidence`) at which a frame is as likely clean as not.
    tolerance: float = 1.2
    #: Validation frames, which are clean, raise it to the median of what is found against them.
    validated: bool = True
    #: Deviation from which a cue by itself calls a frame blurred or misplaced.
    clear_deviation: float = 3.0
    #: Least weight of a frame in the fit.
    weight_floor: float = 0.1
    #: Chance that omega is dropped in a clean frame.
    omega_dropout: float = 0.3
    #: A frame is clean for `omega_dropout` from this probability on.
    clean_threshold: float = 0.5
    #: Residual, in those of the clean frames at the same place, at which a pixel's weight has
    #: halved.
    residual_scale: float = 2.5
    #: Distance of a pixel's tint from the skin's, in those of the clean frames at the same place,
    #: at which its weight has halved.
    tint_scale: float = 4.0
    #: Factor on both scales in a frame that is surely clean. Little can cover the hand there, and
    #: what looks odd (nails, rings, seams of a glove a little off their place) belongs to it.
    clean_scale: float = 4.0
    #: Pixels that what is normal in the clean frames is worth in what is normal at a place.
    residual_prior: float = 20.0
    #: Fewer usable frames than this cannot be compared: all are judged clean. Nor do fewer
    #: validation frames raise the tolerance.
    least_frames: int = 4


#: The cue that tells each perturbation, and how many of its deviations make one level: about
#: what they are on simulated captures, where the levels are known (docs/prepass.md).
CUES: Mapping[str, tuple[str, float]] = MappingProxyType(
    {
        "hand_object_interaction": ("hidden_deviation", 1.0),
        "complex_poses": ("misplacement_deviation", 5.0),
        "illumination": ("gain_deviation", 2.5),
        "motion_blur": ("blur_deviation", 0.7),
    }
)
#: A frame at or above this probability counts as unperturbed.
CLEAN_FROM = 0.5


@dataclass(frozen=True, eq=False)
class FrameAssessment:
    """R training frames, in the order in which they were given.

    Deviations are in robust standard deviations of the frames that agree, one-sided: 0 = as
    normal as most frames, 3 = clearly off.
    """

    #: (R,) which frames of the capture they are.
    indices: np.ndarray
    #: (R,) bool: the estimated hands are valid, lie in the image, and mask and frame show
    #: something. Other frames are judged unclean with gain 0.
    usable: np.ndarray
    #: (R,) probability in [0, 1] that nothing perturbs the frame.
    clean: np.ndarray
    #: (R,) weight of the frame in the fit, from the floor to 1.
    frame_weights: np.ndarray
    #: (R,) chance that omega is dropped in training: only where the frame is judged clean.
    omega_dropout: np.ndarray
    #: (R,) bool: sharp frames whose mask says that the hand is elsewhere.
    refine_pose: np.ndarray
    #: (R, 3) log gain of linear light by channel, relative to the mode of the gains.
    log_gains: np.ndarray
    #: (R,) deviation of the gain from the mode.
    gain_deviation: np.ndarray
    #: (R,) median log residual of the hand under the intensity model, in [0, inf).
    residual: np.ndarray
    #: (R,) deviation of the log of `residual`.
    residual_deviation: np.ndarray
    #: (R,) sharpness: share of the expected texture that shows; about 1 or more when sharp.
    sharpness: np.ndarray
    #: (R,) deviation of border width and texture towards blur, the larger of the two.
    blur_deviation: np.ndarray
    #: (R,) estimated extent of the blur in its strongest direction, px.
    blur_extent: np.ndarray
    #: (R,) mean distance of the mask's outline outside the silhouette, share of the hand's size.
    misplacement: np.ndarray
    #: (R,) deviation of `misplacement`.
    misplacement_deviation: np.ndarray
    #: (R,) share of the hand, where masks show it in other frames, that this mask lacks.
    hidden: np.ndarray
    #: (R,) deviation of `hidden`.
    hidden_deviation: np.ndarray
    #: (R,) median path of the projected hand since the frame before, px; 0 where that is not a
    #: training frame. From the parameters only; it does not enter `clean`.
    motion: np.ndarray
    #: (R, H, W) uint8, 255 = full weight: initial weights of the pixels.
    pixel_weights: np.ndarray

    def __len__(self) -> int:
        return len(self.indices)

    def shared_mismatch(self, floor: float) -> float:
        """The misplacement that every frame shares: that of the best tenth of the usable frames.

        A hand that is not the model, or a tracker that is always a little wrong, leaves it. It is
        no perturbation of any frame.

        Args:
            floor: misplacement that counts as 1 (`PrepassSettings.misplacement_floor`).
        """
        found = self.misplacement[self.usable]
        return float(np.quantile(found, 0.1)) / floor if len(found) and floor > 0.0 else 0.0


def neutral_assessment(
    indices: np.ndarray, usable: np.ndarray, size: tuple[int, int], omega_dropout: float
) -> FrameAssessment:
    """Call every usable frame clean, because there is too little to compare.

    Args:
        indices: (R,) frames.
        usable: (R,) bool.
        size: height and width.
        omega_dropout: chance for clean frames.
    """
    count = len(indices)
    good = usable.astype(np.float64)
    zeros = np.zeros(count)
    return FrameAssessment(
        indices=indices,
        usable=usable,
        clean=good,
        frame_weights=np.ones(count),
        omega_dropout=omega_dropout * good,
        refine_pose=np.zeros(count, dtype=bool),
        log_gains=np.zeros((count, 3)),
        gain_deviation=zeros,
        residual=zeros,
        residual_deviation=zeros,
        sharpness=np.ones(count),
        blur_deviation=zeros,
        blur_extent=zeros,
        misplacement=zeros,
        misplacement_deviation=zeros,
        hidden=zeros,
        hidden_deviation=zeros,
        motion=zeros,
        pixel_weights=np.full((count, *size), 255, dtype=np.uint8),
    )


def enlarged(assessment: FrameAssessment, factor: int, size: tuple[int, int]) -> FrameAssessment:
    """The assessment of shrunk frames, brought back to their size.

    Args:
        assessment: of frames at 1 / factor of the resolution.
        factor: at least 1.
        size: height and width of the frames.
    """
    weights = [
        cv2.resize(weight, size[::-1], interpolation=cv2.INTER_LINEAR)
        for weight in assessment.pixel_weights
    ]
    return replace(
        assessment,
        pixel_weights=np.stack(weights),
        blur_extent=assessment.blur_extent * factor,
        motion=assessment.motion * factor,
    )


def estimated_severity(assessment: FrameAssessment) -> dict[str, np.ndarray]:
    """Guess how strongly each perturbation acts in each frame.

    Each cue also reacts to other perturbations: blur moves outlines, and an object hides texture.
    `assessment.clean` is reliable; how it is split among the perturbations is a guess.

    Args:
        assessment: of R frames.

    Returns:
        (R,) int, 0-5, for each perturbation of the taxonomy; 0 wherever the frame is judged
        clean or cannot be used.
    """
    acting = (assessment.clean < CLEAN_FROM) & assessment.usable
    levels = {}
    for kind, (cue, deviations) in CUES.items():
        level = np.clip(np.rint(getattr(assessment, cue) / deviations), 0, 5)
        levels[kind] = np.where(acting, level, 0).astype(np.int64)
    return levels


def densest(values: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Find the values that lie closest together.

    The value whose `share` nearest values are nearest to it is the middle; they are the part.

    Args:
        values: (F, K) float, finite; F at least 1.
        share: part of the values that must agree, in (0, 1].

    Returns:
        (K,) mean of the part, and (F,) bool which values it holds.
    """
    count = min(len(values), max(2, round(share * len(values))))
    squares = (values**2).sum(axis=1)
    distance = squares[:, None] + squares[None] - 2.0 * values @ values.T
    radius = np.partition(distance, count - 1, axis=1)[:, count - 1]
    nearest = np.argsort(distance[int(np.argmin(radius))], kind="stable")[:count]
    part = np.zeros(len(values), dtype=bool)
    part[nearest] = True
    return values[part].mean(axis=0), part


def normal_value(values: np.ndarray, share: float) -> tuple[float, float]:
    """Median and robust deviation of the shortest part of the values: those that are normal.

    Args:
        values: (F,) float; those that are not finite are left out.
        share: part of the values that is normal at least, in (0, 1].

    Returns:
        Both 0 where no value is finite.
    """
    known = np.sort(values[np.isfinite(values)])
    if not len(known):
        return 0.0, 0.0
    count = min(len(known), max(2, round(share * len(known))))
    width = known[count - 1 :] - known[: len(known) - count + 1]
    start = int(np.argmin(width))
    normal = float(np.median(known[start : start + count]))
    # Half of the shortest part that holds a share s of a normal distribution is z(s) deviations.
    return normal, 0.5 * float(width[start]) / _half_width(count / len(known))


def excess(values: np.ndarray, share: float, floor: float) -> np.ndarray:
    """How far values lie above what is normal among them, in robust deviations.

    Args:
        values: (F,) float; not finite counts as normal.
        share: part of the values that is normal at least.
        floor: least deviation that counts as one, positive.

    Returns:
        (F,) float64, 0 where a value is not above normal.
    """
    normal, deviation = normal_value(values, share)
    above = np.maximum(values - normal, 0.0) / max(deviation, floor)
    return np.where(np.isfinite(values), above, 0.0)


def _half_width(share: float) -> float:
    """Deviations to either side of the mean that hold a share of a normal distribution."""
    from scipy.special import ndtri

    return float(ndtri(0.5 + 0.5 * min(share, 0.99)))
