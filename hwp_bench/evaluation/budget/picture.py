"""The picture of an error budget: a test frame of each capture with every truth and correction."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hwp_bench.base.drawing import PAPER, error_map, fitted, labelled, sheet
from hwp_bench.base.images import as_uint8
from hwp_bench.evaluation.budget.budget import Budget
from hwp_bench.evaluation.budget.corrections import CORRECTIONS
from hwp_bench.evaluation.budget.frames import pairs_of
from hwp_bench.evaluation.budget.pair import Pair, error_of
from hwp_bench.evaluation.budget.runs import GIVEN, BudgetRuns
from hwp_bench.metrics.pixels import decibels

# Larger side of a tile, px, and pixels around the hand.
_EDGE, _MARGIN = 176, 4


def budget_sheet(runs: BudgetRuns, budget: Budget) -> np.ndarray:
    """Draw two rows for each capture, with PSNR over the tiles.

    The first has the truth, the method as it is, and the method with each truth; the second the
    error of the method as it is, and its corrections.

    Args:
        runs: the evaluations.
        budget: says which frame of each capture is shown.

    Returns:
        (rows, columns, 3) uint8.
    """
    columns = 1 + max(len(runs.results), len(CORRECTIONS))
    tiles: list[np.ndarray] = []
    for capture in runs.captures:
        name = capture.info.id
        frame = budget.shown[name]
        pairs = {
            variant: next(pairs_of(capture, folder / "captures" / name / "predictions", [frame]))[1]
            for variant, folder in runs.folders.items()
        }
        for row in _rows(f"{name} {frame}", pairs):
            tiles += [*row, *[_blank("")] * (columns - len(row))]
    return sheet(tiles, columns)


def _rows(title: str, pairs: Mapping[str, Pair | None]) -> list[list[np.ndarray]]:
    sound = next((pair for pair in pairs.values() if pair is not None), None)
    first = [_blank(f"{title} failed") if sound is None else _tile(sound.target, sound, title)]
    for name, pair in pairs.items():
        first.append(_blank(f"{name} failed") if pair is None else _scored(name, pair, None))
    given = pairs[GIVEN]
    if given is None:
        return [first, [_blank(f"{GIVEN} failed")]]
    wrong = error_map(as_uint8(given.prediction), as_uint8(given.target), given.region)
    second = [_tile(wrong / 255.0, given, f"error {GIVEN}")]
    second += [_scored(name, given, correct(given)) for name, (correct, _) in CORRECTIONS.items()]
    return [first, second]


def _scored(name: str, pair: Pair, image: np.ndarray | None) -> np.ndarray:
    shown = pair.prediction if image is None else image
    return _tile(shown, pair, f"{name} {decibels(error_of(shown, pair)):.1f}")


def _tile(image: np.ndarray, pair: Pair, text: str) -> np.ndarray:
    """The hand's square of an image (H, W, 3) in [0, 1], black around the scored pixels."""
    shown = as_uint8(np.clip(image, 0.0, 1.0) * pair.region[..., None])
    rows, columns = np.nonzero(pair.region)
    half = int(max(np.ptp(rows), np.ptp(columns))) // 2 + _MARGIN
    top, left = int(rows.min() + rows.max()) // 2, int(columns.min() + columns.max()) // 2
    padded = np.pad(shown, ((half, half), (half, half), (0, 0)))
    return labelled(fitted(padded[top : top + 2 * half, left : left + 2 * half], _EDGE), text)


def _blank(text: str) -> np.ndarray:
    return labelled(np.full((_EDGE, _EDGE, 3), PAPER, dtype=np.uint8), text)
