"""Corrections of predicted frames. Oracle: the error that was put in."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.base.colors import harmonics, linear_to_srgb, srgb_to_linear
from hwp_bench.evaluation.budget.budget import measure_gain
from hwp_bench.evaluation.budget.corrections import CORRECTIONS
from hwp_bench.evaluation.budget.surface import Pair

SIZE = 48
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE] / SIZE - 0.5
REGION = ROWS**2 + COLUMNS**2 < 0.12


def sphere() -> np.ndarray:
    """(SIZE, SIZE, 3) normals of a ball in the region."""
    depth = np.sqrt(np.maximum(0.12 - ROWS**2 - COLUMNS**2, 0.0))
    normals = np.stack([COLUMNS, ROWS, -depth], axis=-1) / np.sqrt(0.12)
    return np.where(REGION[..., None], normals, 0.0)


def picture() -> np.ndarray:
    """A smooth coloured pattern, far from black and white."""
    waves = 0.45 + 0.15 * np.sin(14.0 * COLUMNS) * np.cos(11.0 * ROWS)
    return np.stack([waves + 0.1, waves, waves - 0.1], axis=-1)


def lit(image: np.ndarray, logs: np.ndarray) -> np.ndarray:
    return linear_to_srgb(srgb_to_linear(image) * np.exp(logs))


def pair_of(prediction: np.ndarray) -> Pair:
    return Pair(prediction, picture(), REGION, sphere())


def test_a_gain_is_found_exactly() -> None:
    pair = pair_of(lit(picture(), np.array([0.4, -0.3, 0.2])))
    for name in ("gain", "light", "gain map"):
        assert measure_gain(CORRECTIONS[name][0](pair), pair) > 40.0, name


def test_another_light_is_found_and_one_gain_is_not_enough() -> None:
    weights = np.random.default_rng(1).normal(0.0, 0.15, (9, 3))
    pair = pair_of(lit(picture(), harmonics(sphere()) @ weights))
    assert measure_gain(CORRECTIONS["light"][0](pair), pair) > 40.0
    assert measure_gain(CORRECTIONS["gain"][0](pair), pair) < 15.0


def test_an_affine_motion_is_found() -> None:
    matrix = np.array([[1.02, 0.03, 1.3], [-0.03, 1.02, -1.8]])
    moved = cv2.warpAffine(picture(), matrix, (SIZE, SIZE), borderMode=cv2.BORDER_REFLECT)
    pair = pair_of(moved)
    # Resampled twice with linear weights: what is left is the loss of that.
    assert measure_gain(CORRECTIONS["motion"][0](pair), pair) > 15.0
    assert measure_gain(CORRECTIONS["gain"][0](pair), pair) < 3.0


def test_both_together_find_both() -> None:
    weights = np.random.default_rng(2).normal(0.0, 0.1, (9, 3))
    dim = lit(picture(), harmonics(sphere()) @ weights)
    matrix = np.array([[1.0, 0.0, 1.5], [0.0, 1.0, 0.5]])
    pair = pair_of(cv2.warpAffine(dim, matrix, (SIZE, SIZE), borderMode=cv2.BORDER_REFLECT))
    both = measure_gain(CORRECTIONS["motion+light"][0](pair), pair)
    assert both > measure_gain(CORRECTIONS["motion"][0](pair), pair) + 3.0
    assert both > measure_gain(CORRECTIONS["light"][0](pair), pair) + 3.0


@settings(max_examples=25)
@given(
    kind=st.sampled_from(["noise", "black", "white", "truth", "one colour"]),
    seed=st.integers(0, 2**16),
    name=st.sampled_from(sorted(CORRECTIONS)),
)
def test_no_prediction_gives_a_nan_or_a_loss(kind: str, seed: int, name: str) -> None:
    random = np.random.default_rng(seed)
    prediction = {
        "noise": random.uniform(0.0, 1.0, (SIZE, SIZE, 3)),
        "black": np.zeros((SIZE, SIZE, 3)),
        "white": np.ones((SIZE, SIZE, 3)),
        "truth": picture(),
        "one colour": np.broadcast_to(random.uniform(0.0, 1.0, 3), (SIZE, SIZE, 3)).copy(),
    }[kind]
    pair = pair_of(prediction)
    image = CORRECTIONS[name][0](pair)
    assert image.shape == prediction.shape
    assert np.isfinite(image).all()
    assert image.min() >= 0.0
    assert image.max() <= 1.0 + 1e-6
    assert measure_gain(image, pair) >= 0.0
