"""From the measurements of all frames to the judgement."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from wildghand.prepass.judgement import Judgement
from wildghand.prepass.look import Look
from wildghand.prepass.mode import densest, excess, normal_value
from wildghand.prepass.settings import PrepassSettings
from wildghand.prepass.verdict import clean_probability, evidence
from wildghand.prepass.weights import weigh_pixels


def conclude(
    indices: np.ndarray,
    masks: np.ndarray,
    looks: Mapping[int, Look],
    cell_count: int,
    settings: PrepassSettings,
) -> Judgement:
    """Compare the frames with each other and judge them.

    Args:
        indices: (R,) ascending frame numbers.
        masks: (R, H, W) uint8.
        looks: by row; rows that are missing cannot be used. Not empty.
        cell_count: number of cells of the surface.
        settings: floors and thresholds.
    """
    count, share = len(indices), settings.clean_share
    rows = np.array(sorted(looks))
    usable = np.zeros(count, dtype=bool)
    usable[rows] = True

    def gathered(values: list[float] | list[np.ndarray]) -> np.ndarray:
        return np.array(values, dtype=np.float64)

    def spread(values: np.ndarray, missing: float = 0.0) -> np.ndarray:
        result = np.full((count, *values.shape[1:]), missing)
        result[rows] = values
        return result

    found = [looks[row] for row in rows.tolist()]
    gains = gathered([look.explained.gain for look in found])
    gains = gains - densest(gains, share)[0]
    level = gathered([look.explained.level for look in found])
    texture = gathered([look.explained.texture for look in found])
    border = gathered([look.border for look in found])
    misplaced = gathered([look.misplacement for look in found])
    hidden = gathered([look.hidden for look in found])

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
    return Judgement(
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
        motion=spread(gathered([look.motion for look in found])),
        pixel_weights=weigh_pixels(masks, looks, clean, cell_count, settings),
    )
