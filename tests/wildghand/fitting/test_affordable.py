"""Frames that a budget has room for. Oracle: their number and spread by hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hwp_bench.methods import find_method, read_manifest
from hwp_bench.methods.contract import Budget, TrainingCapture
from wildghand.fitting.method import affordable
from wildghand.model.settings import read_settings


@pytest.fixture
def training(make_training: Callable[..., TrainingCapture]) -> TrainingCapture:
    return make_training("right")


@pytest.mark.parametrize(
    ("seconds", "share", "kept"),
    [
        (5.0, 4.0, 20),
        (1.0, 4.0, 16),
        (0.0, 4.0, 16),
        (5.0, 0.0, 32),
        (None, 4.0, 32),
        (8.0, 4.0, 32),
    ],
)
def test_frames_are_left_out_by_the_second(
    training: TrainingCapture, seconds: float | None, share: float, kept: int
) -> None:
    settings = read_settings({"schedule.frames_per_second": share})
    assert len(training.train) == 32
    fewer = affordable(training, settings, Budget(seconds=seconds))
    assert len(fewer.train) == kept
    # Evenly spread: the first and the last are there, and no gap is twice another.
    assert (fewer.train[0], fewer.train[-1]) == (training.train[0], training.train[-1])
    rows = np.searchsorted(training.train, fewer.train)
    assert np.diff(rows).max() <= np.diff(rows).min() + 1
    # The capture itself keeps its frames.
    assert len(training.train) == 32
    assert fewer.validation.tolist() == training.validation.tolist()


def test_the_network_alone_takes_all_frames_as_other_baselines_do(
    training: TrainingCapture,
) -> None:
    for preset in read_manifest(find_method("network-scratch")).presets.values():
        assert affordable(training, read_settings(preset), Budget(seconds=1.0)) is training
