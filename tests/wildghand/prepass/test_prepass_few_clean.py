"""Few clean frames or none: the pre-pass says so, and its weights are relative.

Oracle: what was done to the light of each frame.
"""

from __future__ import annotations

import numpy as np
import pytest
from lit_hand import FRAMES, Lit, as_input, check_ranges, developed, only
from scipy.stats import spearmanr

from wildghand.prepass import frames_text, judge_frames
from wildghand.prepass.assessment import CLEAN_SHARE

#: The last frames are known to be clean.
KNOWN = np.arange(18, FRAMES)
TRAINING = np.arange(18)


def dimmed(lit_frames: Lit, clean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Linear light with most training frames darkened, and how much each of them was."""
    stops = np.linspace(0.5, 1.2, len(TRAINING))
    stops[clean] = 0.0
    linear = lit_frames[0].copy()
    linear[TRAINING] *= np.exp(-stops)[:, None, None, None]
    return linear, stops


@pytest.mark.parametrize("count", [0, 2, 4])
def test_frames_are_compared_with_those_known_to_be_clean_where_few_are(
    lit_frames: Lit, count: int
) -> None:
    """Most frames are dark: what most frames have is not what is clean."""
    clean = np.array([3, 4, 11, 12])[:count]
    linear, stops = dimmed(lit_frames, clean)
    given = as_input(developed(linear), lit_frames[1])
    judged = judge_frames(only(given, TRAINING), known_clean=only(given, KNOWN))
    check_ranges(judged, len(TRAINING))
    assert np.flatnonzero(judged.clean >= 0.5).tolist() == clean.tolist()
    assert judged.clean_share == pytest.approx(count / len(TRAINING))
    # Gains are those that were injected, relative to the clean frames.
    np.testing.assert_allclose(judged.log_gains.mean(axis=1), -stops, atol=0.1)
    # Weights are relative: the less a frame is darkened the more it counts, and none is lost.
    assert spearmanr(judged.frame_weights, -stops).statistic >= 0.8
    assert judged.frame_weights.min() > 0.3
    best = judged.frame_weights >= 0.6
    assert best.sum() >= CLEAN_SHARE * len(TRAINING) - 1
    # Biases are dropped in clean frames, and where there are too few of these in the best ones.
    dropped = clean if count == 4 else np.flatnonzero(best)
    assert np.flatnonzero(judged.omega_dropout).tolist() == dropped.tolist()


def test_without_known_frames_the_densest_part_of_the_clip_is_clean(lit_frames: Lit) -> None:
    linear, _ = dimmed(lit_frames, np.array([3, 4]))
    given = as_input(developed(linear), lit_frames[1])
    judged = judge_frames(only(given, TRAINING))
    assert judged.clean_share >= CLEAN_SHARE


@pytest.mark.parametrize(
    ("clean", "weights", "text"),
    [
        ([0.9, 0.6, 0.2], [0.92, 0.68, 0.36], "2 of 3 training frames are judged clean."),
        (
            [0.1] * 9 + [0.9, 0.9, 0.9],
            [0.3] * 8 + [0.7] + [0.95] * 3,
            "3 of 12 training frames are judged clean: weights are relative, no frame is "
            "discarded, and the 4 least perturbed ones count most.",
        ),
        (
            [0.1] * 6,
            [0.3] * 4 + [0.8] * 2,
            "0 of 6 training frames are judged clean: weights are relative, no frame is "
            "discarded, and the 2 least perturbed ones are learnt from as if they were clean.",
        ),
    ],
)
def test_what_is_done_with_few_clean_frames_is_said(
    clean: list[float], weights: list[float], text: str
) -> None:
    assert frames_text(clean, weights, 0.2) == text
