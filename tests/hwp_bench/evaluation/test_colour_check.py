"""Colours of another range or order are said; honest predictions are not accused.

Oracle: predictions that are made wrong on purpose, with their mean computed by hand.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_captures import CaptureMaker, hand_picture

from hwp_bench.base.images import as_uint8, write_image
from hwp_bench.cli.main import main
from hwp_bench.evaluation.scoring import Prediction, Target, colour_warnings


def _targets() -> list[Target]:
    pictures = [hand_picture(frame, 48) for frame in range(4)]
    return [Target(i, picture, mask, False) for i, (picture, mask) in enumerate(pictures)]


def _said(change) -> list[str]:
    targets = _targets()
    drawn = [Prediction(t.frame, change(t.pixels), None) for t in targets]
    return colour_warnings(targets, drawn)


def test_colours_up_to_255_in_place_of_1_are_said_with_their_mean() -> None:
    (text,) = _said(lambda pixels: as_uint8(pixels.astype(np.float64)))
    assert "100 % of the predicted colours are 255" in text
    assert "mean is 255.0 of 255, the truth's" in text


def test_colours_up_to_1_in_place_of_255_are_said() -> None:
    (text,) = _said(lambda pixels: (pixels / 255.0).astype(np.uint8))
    assert "above 0 of 255" in text or "above 1 of 255" in text


def test_exchanged_channels_are_said_with_both_scores() -> None:
    (text,) = _said(lambda pixels: np.ascontiguousarray(pixels[:, :, ::-1]))
    assert "red and blue exchanged" in text


def test_frames_without_a_prediction_are_left_out() -> None:
    targets = _targets()
    assert colour_warnings(targets, [Prediction(t.frame, None, "missing") for t in targets]) == []


@given(
    st.tuples(*[st.floats(0.8, 1.2)] * 3),
    st.integers(0, 40),
    st.integers(0, 2**31),
)
def test_poor_predictions_are_not_accused(gains, noise: int, seed: int) -> None:
    random = np.random.default_rng(seed)

    def worse(pixels: np.ndarray) -> np.ndarray:
        changed = pixels * np.array(gains) + random.normal(0, noise + 1e-9, pixels.shape)
        return changed.clip(0, 255).astype(np.uint8)

    assert _said(worse) == []


@pytest.mark.parametrize("level", [0, 128, 240])
def test_an_even_picture_is_not_accused_of_an_order(level: int) -> None:
    assert all("exchanged" not in text for text in _said(lambda p: np.full_like(p, level)))


def test_evaluate_warns_and_leaves_the_score_alone(
    make_capture: CaptureMaker, tmp_path: Path, capsys
) -> None:
    capture = make_capture(frames=20, size=48)
    entry, out = tmp_path / "entry", tmp_path / "out"
    for frame in (18, 19):
        pixels = np.ascontiguousarray(capture.frame(frame)[:, :, ::-1])
        write_image(entry / "predictions" / "tiny" / f"{frame:06d}.png", pixels)
    (entry / "method.toml").write_text(
        'schema = "hwp-method/1"\nname = "bgr"\n[entry]\npredictions = "predictions"\n'
    )
    words = ["evaluate", str(entry), "--capture", str(capture.root), "--out", str(out)]
    assert main(words) == 0
    captured = capsys.readouterr()
    assert "warning: tiny: with red and blue exchanged" in " ".join(captured.err.split())
    assert "100.00" not in captured.out
