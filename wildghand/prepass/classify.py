"""Frames are compared with each other: which are clean, how sure that is, and what is off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from wildghand.prepass.assessment import FrameAssessment
from wildghand.prepass.measurements import FrameMeasurements
from wildghand.prepass.robust_location import densest, excess, normal_value
from wildghand.prepass.settings import PrepassSettings

# Deviation at which a cue starts to count; it grows like a logarithm beyond.
_ONSET = 3.0
# Steepness of the probability.
_EXPONENT = 3


def classify_frames(
    indices: np.ndarray,
    size: tuple[int, int],
    measured: Mapping[int, FrameMeasurements],
    settings: PrepassSettings,
    tolerance: float,
) -> FrameAssessment:
    """Compare the frames with each other and assess them; every pixel has full weight.

    Args:
        indices: (R,) ascending frame numbers.
        size: height and width of the frames.
        measured: by row; rows that are missing cannot be used. Not empty.
        settings: floors and thresholds.
        tolerance: evidence at which a frame is as likely clean as not (`clip_tolerance`).
    """
    count = len(indices)
    rows = np.array(sorted(measured))
    usable = np.zeros(count, dtype=bool)
    usable[rows] = True

    def spread(values: np.ndarray, missing: float = 0.0) -> np.ndarray:
        result = np.full((count, *values.shape[1:]), missing)
        result[rows] = values
        return result

    found = [measured[row] for row in rows.tolist()]
    cues = _compare(found, settings)
    found_evidence = evidence(cues.deviations, indices[rows], settings.tolerance)
    clean = spread(clean_probability(found_evidence, tolerance))
    border, texture = _gathered(found, "border"), _gathered(found, "texture")
    sharp_border = float(np.exp(normal_value(np.log(border), settings.clean_share)[0]))
    extent = np.sqrt(np.maximum(np.nan_to_num(border) ** 2 - sharp_border**2, 0.0))
    clear = settings.clear_deviation
    refine = (cues.misplacement > clear) & (cues.border < clear)
    return FrameAssessment(
        indices=indices,
        usable=usable,
        clean=clean,
        frame_weights=settings.weight_floor + (1.0 - settings.weight_floor) * clean,
        omega_dropout=np.where(clean >= settings.clean_threshold, settings.omega_dropout, 0.0),
        refine_pose=spread(refine.astype(np.float64)) > 0.5,
        log_gains=spread(cues.gains),
        gain_deviation=spread(cues.gain),
        residual=spread(_gathered(found, "level")),
        residual_deviation=spread(cues.level),
        sharpness=spread(np.nan_to_num(texture, nan=1.0), missing=1.0),
        blur_deviation=spread(np.maximum(cues.border, cues.texture)),
        blur_extent=spread(extent),
        misplacement=spread(_gathered(found, "misplacement")),
        misplacement_deviation=spread(cues.misplacement),
        hidden=spread(_gathered(found, "hidden")),
        hidden_deviation=spread(cues.hidden),
        motion=spread(_gathered(found, "motion")),
        pixel_weights=np.full((count, *size), 255, dtype=np.uint8),
    )


def clip_tolerance(found: np.ndarray, settings: PrepassSettings) -> float:
    """Evidence at which a frame of a clip is as likely clean as not.

    Where poses or masks are poor, cues differ from frame to frame though nothing perturbs any. Most
    frames that are known to be clean must be judged so: they raise the settings' tolerance to the
    median of what is found against them.

    Args:
        found: (K,) evidence of frames of which it is known that nothing perturbs them.
        settings: with the least tolerance, and the frames below which they say nothing.
    """
    if len(found) < settings.least_frames:
        return settings.tolerance
    return max(settings.tolerance, float(np.median(found)))


def evidence_against(
    indices: np.ndarray, measured: Sequence[FrameMeasurements], settings: PrepassSettings
) -> np.ndarray:
    """Compare frames with each other; returns what speaks against each, (R,), not negative.

    Args:
        indices: (R,) frame numbers.
        measured: R frames; at least one.
        settings: floors and thresholds.
    """
    return evidence(_compare(measured, settings).deviations, indices, settings.tolerance)


@dataclass(frozen=True, eq=False)
class _Cues:
    """R frames compared with each other: how far each is off, one-sided, in robust deviations."""

    #: (R, 3) log gains, relative to their mode.
    gains: np.ndarray
    #: (R,) each.
    gain: np.ndarray
    level: np.ndarray
    texture: np.ndarray
    border: np.ndarray
    misplacement: np.ndarray
    hidden: np.ndarray

    @property
    def deviations(self) -> tuple[np.ndarray, ...]:
        """All that speaks against a frame, (R,) each."""
        place = (self.misplacement, self.hidden)
        return (self.gain, self.level, self.texture, self.border, *place)


def _gathered(found: Sequence[FrameMeasurements], name: str) -> np.ndarray:
    """A measurement of all frames, (R, ...)."""
    return np.array([getattr(one, name) for one in found], dtype=np.float64)


def _compare(found: Sequence[FrameMeasurements], settings: PrepassSettings) -> _Cues:
    share = settings.clean_share
    gains = _gathered(found, "gain")
    gains = gains - densest(gains, share)[0]
    level = np.log(np.maximum(_gathered(found, "level"), 1e-4))
    misplaced, hidden = _gathered(found, "misplacement"), _gathered(found, "hidden")
    return _Cues(
        gains=gains,
        gain=excess(np.linalg.norm(gains, axis=1), share, settings.gain_floor),
        level=excess(level, share, settings.residual_floor),
        texture=excess(-_gathered(found, "texture"), share, settings.texture_floor),
        border=excess(np.log(_gathered(found, "border")), share, settings.border_floor),
        misplacement=excess(misplaced, share, settings.misplacement_floor),
        hidden=excess(hidden, share, settings.hidden_floor),
    )


def evidence(deviations: Sequence[np.ndarray], indices: np.ndarray, tolerance: float) -> np.ndarray:
    """Weigh all cues together, and neighbouring frames with them.

    Each cue adds log(1 + (deviation / 3)^2): a single cue can decide, none outweighs the rest.
    Perturbations last for a while, so that a frame takes half of its evidence from the frames
    before and after, if they are given. A neighbour counts up to `tolerance`: it can decide
    about a doubtful frame, but the last clean frame before an episode stays clean.

    Args:
        deviations: arrays (R,), not negative.
        indices: (R,) ascending frame numbers.
        tolerance: evidence at which a frame is as likely clean as not, positive.

    Returns:
        (R,) not negative.
    """
    own = sum((np.log1p((d / _ONSET) ** 2) for d in deviations), start=np.zeros(len(indices)))
    before, after = own.copy(), own.copy()
    neighbours = np.diff(indices) == 1
    heard = np.minimum(own, tolerance)
    before[1:][neighbours] = heard[:-1][neighbours]
    after[:-1][neighbours] = heard[1:][neighbours]
    return 0.25 * before + 0.5 * own + 0.25 * after


def clean_probability(evidence: np.ndarray, tolerance: float) -> np.ndarray:
    """(R,) in (0, 1]: 1 without evidence, a half at `tolerance`."""
    return 1.0 / (1.0 + (evidence / tolerance) ** _EXPONENT)
