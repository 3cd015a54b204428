"""The assessment of frames: its settings, the result of the pre-pass, and robust locations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any, ClassVar

import cv2
import numpy as np

from hwp_bench.methods.settings import number


@dataclass(frozen=True)
class PrepassSettings:
    """How training frames are judged; the defaults suit every capture."""

    #: Judge the frames before the fit.
    enabled: bool = True
    #: Refine the pose of frames whose mask disagrees with it.
    frame_poses: bool = True
    #: Evidence (`wildghand.prepass.judge.evidence`) at which a frame is as likely clean as not.
    tolerance: float = number(1.2, 1e-6, 1e6)
    #: Least weight of a frame in the fit.
    weight_floor: float = number(0.2, 0.0, 1.0)

    #: Least misplacement that counts as one deviation, share of the hand's size: what rounding to
    #: pixels leaves in frames whose poses are true.
    misplacement_floor: ClassVar[float] = 0.0006


#: Share of the frames that is taken to be clean, if frames that are known to be clean do not say
#: otherwise; the densest such part of a cue's values says what is normal. Where fewer frames than
#: this are like the known ones, what is densest is perturbed. On every capture of `mini` and
#: `wild-dev` 0.354 or more are like them.
CLEAN_SHARE = 0.35
#: Fewer clean frames than this do not show a hand: the least perturbed ones stand for them.
LEAST_CLEAN = 3
#: The cue that tells each perturbation, and how many of its deviations make one level: about
#: what they are on simulated captures, where the levels are known
#: (docs/studies/prepass.md).
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
    #: (R,) chance that omega is dropped in training: 1 where the frame is judged clean, else 0.
    #: What little biases took from clean frames, the avatar lacked (docs/dpd_pao.md).
    omega_dropout: np.ndarray
    #: (R,) bool: sharp frames whose mask says that the hand is elsewhere.
    refine_pose: np.ndarray
    #: (R, 3) log gain of linear light by channel, relative to the mode of the gains.
    log_gains: np.ndarray
    #: (R,) deviation of the gain from the mode.
    gain_deviation: np.ndarray
    #: (R,) median log residual of the hand under the intensity model, in [0, inf).
    residual: np.ndarray
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
    #: Share of the frames that is judged clean, 0 to 1.
    clean_share: float

    def __len__(self) -> int:
        return len(self.indices)

    def shared_mismatch(self, floor: float) -> float:
        """The misplacement that every frame shares: that of the best tenth of the usable frames.

        A hand that is not the model, or a tracker that is always a little wrong, leaves it. It is
        no perturbation of any frame.
        """
        found = self.misplacement[self.usable]
        return float(np.quantile(found, 0.1)) / floor if len(found) and floor > 0.0 else 0.0


def frames_text(clean: Sequence[float], frame_weights: Sequence[float], floor: float) -> str:
    """Say how many frames are judged clean, and what follows where they are few.

    Args:
        clean: probability of each frame that nothing perturbs it.
        frame_weights: weight of each frame in the fit, from the floor to 1.
    """
    count, good = len(clean), sum(value >= CLEAN_FROM for value in clean)
    text = f"{good} of {count} training frames are judged clean"
    pairs = zip(clean, frame_weights, strict=True)
    if all(abs(weight - floor - (1.0 - floor) * value) < 1e-3 for value, weight in pairs):
        return f"{text}."
    best = sum(weight >= floor + (1.0 - floor) * CLEAN_FROM for weight in frame_weights)
    text += f": weights are relative, no frame is discarded, and the {best} least perturbed ones"
    if good < LEAST_CLEAN:
        return f"{text} are learnt from as if they were clean."
    return f"{text} count most."


def neutral_assessment(
    indices: np.ndarray, usable: np.ndarray, size: tuple[int, int]
) -> FrameAssessment:
    """Call every usable frame, (R,) bool, clean, because there is too little to compare."""
    zeros, good = np.zeros(len(indices)), usable.astype(np.float64)
    nothing: dict[str, Any] = {item.name: zeros for item in fields(FrameAssessment)}
    return FrameAssessment(
        **nothing
        | {
            "indices": indices,
            "usable": usable,
            "clean": good,
            "omega_dropout": good,
            "frame_weights": np.ones(len(indices)),
            "refine_pose": np.zeros(len(indices), dtype=bool),
            "log_gains": np.zeros((len(indices), 3)),
            "pixel_weights": np.full((len(indices), *size), 255, dtype=np.uint8),
            "clean_share": float(good.mean()),
        }
    )


def enlarged(assessment: FrameAssessment, factor: int, size: tuple[int, int]) -> FrameAssessment:
    """The assessment of frames at 1 / factor of the resolution, brought back to their size."""
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
    """Find the part of (F, K) finite values, a share of them, that lies closest together.

    The value whose `share` nearest values are nearest to it is the middle; they are the part.

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
    """Median and robust deviation of the shortest part, a share, of (F,) finite values.

    Values that are not finite are left out; both numbers are 0 where none is finite.
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
    """How far (F,) values lie above what is normal among them, in robust deviations; else 0.

    The floor is the least deviation that counts as one. Values that are not finite are normal.
    """
    normal, deviation = normal_value(values, share)
    above = np.maximum(values - normal, 0.0) / max(deviation, floor)
    return np.where(np.isfinite(values), above, 0.0)


def _half_width(share: float) -> float:
    """Deviations to either side of the mean that hold a share of a normal distribution."""
    from scipy.special import ndtri

    return float(ndtri(0.5 + 0.5 * min(share, 0.99)))
