"""From deviations to a verdict on every frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# Deviation at which a cue starts to count; it grows like a logarithm beyond.
_ONSET = 3.0
# Steepness of the verdict.
_EXPONENT = 3


def evidence(deviations: Sequence[np.ndarray], indices: np.ndarray, tolerance: float) -> np.ndarray:
    """Weigh all cues together, and neighbouring frames with them.

    Each cue adds log(1 + (deviation / 3)^2): one cue alone may speak, none outshouts the rest.
    Perturbations last for a while, so that a frame takes half of its evidence from the frames
    before and after where those are there. A neighbour counts up to `tolerance`: it can decide
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
