"""Errors of an import against truth. Oracle: errors that were put in."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.importer_errors import changed, hand_errors
from hwp_bench.hands import load_template
from hwp_bench.hands.parameters import HandParameters
from hwp_bench.importers.video import FitSettings


def test_a_shift_is_found_in_space_and_in_the_image() -> None:
    template = load_template("anny", "right")
    pose = 0.2 * np.random.default_rng(0).normal(size=(3, 16, 3))
    valid = np.ones(3, dtype=bool)
    truth = HandParameters(pose, np.zeros(10), np.tile([0.0, 0.0, 50.0], (3, 1)), valid)
    moved = HandParameters(pose, np.zeros(10), truth.transl + np.array([0.01, 0, 0]), valid)
    found = hand_errors(moved, truth, 5000.0, template)
    assert found.joints == pytest.approx(10.0)
    assert found.shape == pytest.approx(0.0, abs=1e-9)
    # 10 mm at 50 m: the hand's own depth changes it by less than 0.5 %.
    assert found.image == pytest.approx(1.0, rel=0.005)
    assert found.parts == pytest.approx([1.0] * 6, rel=0.005)
    assert found.wrist == pytest.approx(0.0, abs=1e-6)


def test_settings_keep_their_types() -> None:
    settings = changed(FitSettings(), ["texture_weight=0", "contour_rounds=2"])
    assert settings.texture_weight == 0.0
    assert settings.contour_rounds == 2
    assert isinstance(settings.contour_rounds, int)
