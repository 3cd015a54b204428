"""Predictions whose colours cannot be meant: of another range, or with red and blue exchanged.

The scores are what they are. These sentences tell an author why they may be so low.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import BadInput
from hwp_bench.base.files import read_json, write_json
from hwp_bench.evaluation.scoring import Prediction, Target
from hwp_bench.metrics.pixels import scored_pixels
from hwp_bench.metrics.protocol import HWP_V1

#: The sentences about a capture, inside its result folder; absent where there are none.
WARNINGS = "warnings.json"
#: Share of the scored values that are 255 from which an image is taken to be clipped.
WHITE = 0.9
#: Gain by exchanging red and blue from which the order is doubted, dB.
EXCHANGE_GAIN = 3.0
#: Share of the frames that must be better with them exchanged.
EXCHANGE_FRAMES = 0.75


def colour_warnings(targets: Sequence[Target], predictions: Sequence[Prediction]) -> list[str]:
    """Return sentences about colours that cannot be meant, with the numbers; mostly none.

    Args:
        targets: the truth of the test frames.
        predictions: their predictions, in the same order; frames without one are left out.
    """
    pairs = [
        (prediction.pixels[inside].astype(np.float64), target.pixels[inside].astype(np.float64))
        for target, prediction in zip(targets, predictions, strict=True)
        if prediction.pixels is not None
        for inside in [
            scored_pixels(target.mask, erosion=HWP_V1.mask_erosion, coverage=target.exact)
        ]
    ]
    if not pairs:
        return []
    drawn, true = (np.concatenate(part) for part in zip(*pairs, strict=True))
    means = f"their mean is {drawn.mean():.1f} of 255, the truth's {true.mean():.1f}"
    if drawn.max() <= 1 < true.max():
        return [
            f"no colour of the predictions is above {drawn.max():.0f} of 255 ({means}): were "
            "colours in [0, 1] stored without being multiplied by 255?"
        ]
    white, true_white = float((drawn == 255).mean()), float((true == 255).mean())
    if white > WHITE > 2 * true_white:
        return [
            f"{100 * white:.0f} % of the predicted colours are 255 ({means}): were colours in "
            "[0, 255] returned where [0, 1] is expected? They are clipped."
        ]
    return _exchange_warning(pairs)


def _exchange_warning(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[str]:
    """Compare the squared errors with those of the predictions with red and blue exchanged."""
    kept = np.array([((drawn - true) ** 2).mean() for drawn, true in pairs])
    swapped = np.array([((drawn[:, ::-1] - true) ** 2).mean() for drawn, true in pairs])
    before, after = _psnr(kept.mean()), _psnr(swapped.mean())
    if after - before < EXCHANGE_GAIN or (swapped < kept).mean() < EXCHANGE_FRAMES:
        return []
    return [
        f"with red and blue exchanged the predictions would have {after:.1f} dB in place of "
        f"{before:.1f} dB: are their channels in the order RGB?"
    ]


def _psnr(squared_error: float) -> float:
    return float(10 * np.log10(255.0**2 / max(squared_error, 1e-3)))


def keep_warnings(folder: Path, warnings: Sequence[str]) -> None:
    """Write the sentences into the result folder of a capture; nothing where there are none."""
    if warnings:
        write_json(folder / WARNINGS, list(warnings))


def read_warnings(folder: Path) -> list[str]:
    """Return the sentences that `keep_warnings` left; none where the file is absent or damaged."""
    try:
        value = read_json(folder / WARNINGS, max_bytes=100_000)
    except BadInput:
        return []
    return [text for text in value if isinstance(text, str)] if isinstance(value, list) else []
