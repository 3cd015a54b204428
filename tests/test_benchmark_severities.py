"""Losses of frames by severity. Oracles: scikit-image's PSNR, and shares that are painted."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio

from benchmarks.severities import Loss, draw, losses, rows_of

LEVELS: list[dict[str, int | None]] = [
    {"hand_object_interaction": 2, "illumination": 0},
    {"illumination": 4},
    {"motion_blur": 5, "illumination": 1},  # Two act: neither can be told.
    {"complex_poses": 3},
    {"motion_blur": None},
    {"motion_blur": 1},
]


@pytest.fixture
def capture() -> Any:
    """A hand in the left half, of which the upper quarter is covered."""
    rng = np.random.default_rng(0)
    clean = rng.integers(60, 200, (16, 16, 3), dtype=np.uint8)
    hand = np.zeros((16, 16), np.uint8)
    hand[:, :8] = 255
    hand[:, 8] = 128  # A border counts for nothing.
    visible = hand.copy()
    visible[:4] = 0
    changed = (clean + rng.integers(-20, 20, clean.shape)).astype(np.uint8)

    class Made:
        info = SimpleNamespace(id="c", severity=lambda frame: LEVELS[frame])

        def __len__(self) -> int:
            return len(LEVELS)

        def frame(self, frame: int) -> np.ndarray:
            return clean if frame == 5 else changed

        def clean(self, frame: int) -> np.ndarray:
            return clean

        def true_mask(self, frame: int) -> np.ndarray:
            return visible

        def clean_mask(self, frame: int) -> np.ndarray:
            return hand

    return Made()


def test_frames_in_which_one_perturbation_acts_are_measured(capture: Any) -> None:
    found = losses(capture)
    assert [(one.kind, one.severity, one.where) for one in found] == [
        ("hand_object_interaction", 2, "c, 0"),
        ("illumination", 4, "c, 1"),
        ("motion_blur", 1, "c, 5"),
    ]
    assert found[0].value == pytest.approx(0.25)
    clean, frame = capture.clean(1)[:, :8], capture.frame(1)[:, :8]
    assert found[1].value == pytest.approx(peak_signal_noise_ratio(clean, frame))
    assert found[2].value == 60.0


def test_the_table_has_what_was_found_and_the_picture_is_written(tmp_path: Path) -> None:
    shares = [Loss("hand_object_interaction", 3, value, "c, 0") for value in (0.1, 0.2, 0.3)]
    rows = rows_of([*shares, Loss("motion_blur", 1, 35.0, "c, 1")])
    assert rows == [
        ["Interaction", 3, 3, "17 %", "20 %", "12 %", "28 %"],
        ["Motion Blur", 1, 1, "36.0 dB", "35.0 dB", "35.0 dB", "35.0 dB"],
    ]
    draw(shares, tmp_path / "severities.png")
    assert (tmp_path / "severities.png").stat().st_size > 1000
