"""Many frames: order, failures, penalties, and that threads change nothing."""

from __future__ import annotations

import numpy as np
import pytest

from hwp_bench.base.errors import BadPrediction, ShapeMismatch
from hwp_bench.metrics import HWP_V1, penalty
from hwp_bench.metrics.score import Frame, score_frame, score_frames


def frames(count: int) -> list[Frame]:
    rng = np.random.default_rng(0)
    mask = np.zeros((40, 44), np.uint8)
    mask[8:30, 10:36] = 255
    made = []
    for index in range(count):
        target = rng.integers(0, 256, (40, 44, 3), dtype=np.uint8)
        prediction = np.clip(target + rng.normal(0, 3 + index, target.shape), 0, 255)
        made.append(Frame(prediction.astype(np.uint8), target, mask))
    return made


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_order_and_scores_do_not_depend_on_the_workers(workers):
    listed = frames(30)
    expected = [score_frame(f.prediction, f.target, f.mask) for f in listed]
    got = list(score_frames(iter(listed), workers=workers))
    assert [score.values for score in got] == expected
    assert not any(score.failure or score.empty for score in got)


def test_frames_may_be_read_on_the_workers():
    listed = frames(5)
    lazy = [(lambda frame=frame: frame) for frame in listed]
    assert list(score_frames(lazy, workers=2)) == list(score_frames(listed, workers=2))


def test_a_failed_prediction_costs_its_penalty_and_no_row():
    listed = frames(5)
    target, mask = listed[0].target, listed[0].mask
    listed[1] = Frame(BadPrediction("does not exist", where="0001.png"), target, mask)
    listed[2] = Frame(target[:-1], target, mask)
    listed[3] = Frame(target / 255.0, target, mask)
    got = list(score_frames(listed, (HWP_V1,), workers=2))
    assert len(got) == 5
    assert [score.failure is not None for score in got] == [False, True, True, True, False]
    assert "0001.png: does not exist" in got[1].failure
    assert "(39, 44, 3)" in got[2].failure
    assert "float64" in got[3].failure
    for score in got[1:4]:
        assert score.values == penalty((HWP_V1,))


def test_a_failed_frame_gets_the_penalty_of_the_networks_too():
    broken = Frame(BadPrediction("is empty"), frames(1)[0].target, frames(1)[0].mask)

    def never(x: np.ndarray, y: np.ndarray) -> float:
        raise AssertionError

    (score,) = score_frames([broken], networks={"alex": never})
    assert score.values == penalty(networks=["alex"])


@pytest.mark.parametrize("prediction", ["good", "failed"])
def test_a_frame_without_a_hand_is_empty_whatever_was_predicted(prediction):
    target = frames(1)[0].target
    given = target if prediction == "good" else BadPrediction("does not exist")
    (score,) = score_frames([Frame(given, target, np.zeros((40, 44), np.uint8))])
    assert score.empty
    assert score.failure is None


def test_a_fault_of_the_data_set_is_raised_not_penalised():
    good = frames(3)
    bad = Frame(good[0].prediction, good[0].target, good[0].mask[1:])
    with pytest.raises(ShapeMismatch, match="mask"):
        list(score_frames([*good, bad, *good], workers=2))


def test_a_removed_frame_never_scores_better_than_a_delivered_one():
    """The declared penalties are at the bad end: a noise image gains nothing by failing."""
    rng = np.random.default_rng(0)
    target, mask = frames(1)[0].target, frames(1)[0].mask
    delivered = score_frame(rng.integers(0, 256, target.shape, dtype=np.uint8), target, mask)
    declared = penalty()
    assert delivered["psnr"] > declared["psnr"]
    assert delivered["oriented_distance"] < declared["oriented_distance"]


def test_frames_are_read_only_a_little_ahead():
    read = 0

    def source():
        nonlocal read
        for frame in frames(60):
            read += 1
            yield frame

    results = score_frames(source(), workers=2)
    next(results)
    assert read <= 2 * 4 + 1
    results.close()
