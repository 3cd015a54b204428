"""Means by hand, and nothing dropped."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hwp_bench.base.errors import BadResult
from hwp_bench.metrics.score import CaptureScores, aggregate, mean_scores


def capture(id_, hands, perturbations, scores):
    frames = {index: {"psnr": value} for index, value in enumerate(scores)}
    return CaptureScores(id_, hands, tuple(perturbations), frames)


CAPTURES = [
    capture("a", "right", ["blur", "light"], [10.0, 20.0]),
    capture("b", "both", ["blur"], [30.0, 30.0, 36.0]),
    capture("c", "left", [], [7.0]),
]


def test_by_hand():
    result = aggregate(CAPTURES)
    overall = result.overall
    assert overall.captures == {"a": {"psnr": 15.0}, "b": {"psnr": 32.0}, "c": {"psnr": 7.0}}
    assert overall.perturbations == {"blur": {"psnr": 23.5}, "light": {"psnr": 15.0}}
    assert overall.macro == {"psnr": 19.25}
    assert overall.capture_mean == {"psnr": 18.0}
    assert overall.micro == {"psnr": pytest.approx(133 / 6)}
    assert result.single is not None
    assert result.single.macro == {"psnr": 15.0}
    assert result.single.capture_mean == {"psnr": 11.0}
    assert result.interacting is not None
    assert result.interacting.perturbations == {"blur": {"psnr": 32.0}}


def test_a_clean_capture_has_no_macro_mean_and_no_interacting_half():
    result = aggregate(CAPTURES[2:])
    assert result.overall.macro == {}
    assert result.overall.capture_mean == {"psnr": 7.0}
    assert result.interacting is None


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30), st.randoms())
def test_order_changes_no_digit(values, shuffler: random.Random):
    captures = [
        capture(str(k), ("right", "both")[k % 2], ["p" + str(k % 3)], values[k:] + values[:k])
        for k in range(4)
    ]
    shuffled = captures[:]
    shuffler.shuffle(shuffled)
    reordered = []
    for c in shuffled:
        frames = list(c.frames.items())
        shuffler.shuffle(frames)
        reordered.append(CaptureScores(c.id, c.hands, c.perturbations, dict(frames)))
    assert aggregate(captures) == aggregate(reordered)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_refused_with_its_place(bad):
    with pytest.raises(BadResult, match=r"b: frames\[1\]\.psnr"):
        aggregate([CAPTURES[0], capture("b", "left", [], [1.0, bad])])


def test_missing_frames_metrics_and_captures_are_refused():
    with pytest.raises(BadResult, match="no scored frame"):
        aggregate([capture("a", "left", [], [])])
    with pytest.raises(BadResult, match="no capture"):
        aggregate([])
    with pytest.raises(BadResult, match="twice"):
        aggregate([CAPTURES[0], CAPTURES[0]])
    odd = CaptureScores("d", "left", (), {0: {"psnr": 1.0}, 1: {"psnr": 1.0, "ssim": 1.0}})
    with pytest.raises(BadResult, match=r"d: frames\[1\].*ssim"):
        aggregate([odd])


def test_mean_of_nothing_is_nothing():
    assert mean_scores([]) == {}
