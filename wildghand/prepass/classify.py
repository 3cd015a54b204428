"""Frames are compared with each other: which are clean, how sure that is, and what is off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

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
) -> FrameAssessment:
    """Compare the frames with each other and assess them; every pixel has full weight.

    Args:
        indices: (R,) ascending frame numbers.
        size: height and width of the frames.
        measured: by row; rows that are missing cannot be used. Not empty.
        settings: floors and thresholds.
    """
    count, share = len(indices), settings.clean_share
    rows = np.array(sorted(measured))
    usable = np.zeros(count, dtype=bool)
    usable[rows] = True

    def gathered(values: list[float] | list[np.ndarray]) -> np.ndarray:
        return np.array(values, dtype=np.float64)

    def spread(values: np.ndarray, missing: float = 0.0) -> np.ndarray:
        result = np.full((count, *values.shape[1:]), missing)
        result[rows] = values
        return result

    found = [measured[row] for row in rows.tolist()]
    gains = gathered([one.gain for one in found])
    gains = gains - densest(gains, share)[0]
    level = gathered([one.level for one in found])
    texture = gathered([one.texture for one in found])
    border = gathered([one.border for one in found])
    misplaced = gathered([one.misplacement for one in found])
    hidden = gathered([one.hidden for one in found])

    off_gain = excess(np.linalg.norm(gains, axis=1), share, settings.gain_floor)
    off_level = excess(np.log(np.maximum(level, 1e-4)), share, settings.residual_floor)
    off_texture = excess(-texture, share, settings.texture_floor)
    off_border = excess(np.log(border), share, settings.border_floor)
    off_place = excess(misplaced, share, settings.misplacement_floor)
    off_hidden = excess(hidden, share, settings.hidden_floor)
    cues = (off_gain, off_level, off_texture, off_border, off_place, off_hidden)

    found_evidence = evidence(cues, indices[rows], settings.tolerance)
    clean = spread(clean_probability(found_evidence, settings.tolerance))
    sharp_border = float(np.exp(normal_value(np.log(border), share)[0]))
    extent = np.sqrt(np.maximum(np.nan_to_num(border) ** 2 - sharp_border**2, 0.0))
    refine = (off_place > settings.clear_deviation) & (off_border < settings.clear_deviation)
    return FrameAssessment(
        indices=indices,
        usable=usable,
        clean=clean,
        frame_weights=settings.weight_floor + (1.0 - settings.weight_floor) * clean,
        omega_dropout=np.where(clean >= settings.clean_threshold, settings.omega_dropout, 0.0),
        refine_pose=spread(refine.astype(np.float64)) > 0.5,
        log_gains=spread(gains),
        gain_deviation=spread(off_gain),
        residual=spread(level),
        residual_deviation=spread(off_level),
        sharpness=spread(np.nan_to_num(texture, nan=1.0), missing=1.0),
        blur_deviation=spread(np.maximum(off_border, off_texture)),
        blur_extent=spread(extent),
        misplacement=spread(misplaced),
        misplacement_deviation=spread(off_place),
        hidden=spread(hidden),
        hidden_deviation=spread(off_hidden),
        motion=spread(gathered([one.motion for one in found])),
        pixel_weights=np.full((count, *size), 255, dtype=np.uint8),
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
