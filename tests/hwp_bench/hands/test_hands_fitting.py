"""Fits of a hand to points. Oracle: points of a posed hand, moved by a known distance."""

from __future__ import annotations

from dataclasses import replace

import pytest
from small_captures import hand_parameters

from hwp_bench.hands import HandTemplate
from hwp_bench.hands.fitting import FitTargets, fit_hand
from hwp_bench.hands.skinning import pose_parameters


def test_a_frame_that_the_fit_misses_is_not_a_perfect_one(free_right: HandTemplate) -> None:
    hand = replace(hand_parameters(2), betas=0.0 * hand_parameters(2).betas)
    posed = pose_parameters(free_right, hand)
    skin = posed.vertices[:, ::40].numpy().copy()
    # Out of reach of the surface, which the landmarks hold in place.
    skin[1] += [0.0, 0.0, 0.5]
    targets = FitTargets(posed.landmarks.numpy(), skin=skin)
    found = fit_hand(free_right, targets, hand).skin_mm
    assert found[0] < 3.0
    assert found[1] == pytest.approx(500.0, abs=100.0)
