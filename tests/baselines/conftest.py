"""Captures for the tests of baselines, drawn once in a session."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from painted import FRAMES, QUICK, TrainingMaker, paint_capture

from hwp_bench.capture import Capture
from hwp_bench.methods.contract import Budget
from hwp_bench.methods.request import RunSettings, TrainingCapture, open_request, write_request
from hwp_bench.splits import contiguous_split


@pytest.fixture(scope="session")
def make_painted(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Capture]:
    """Return a function that draws the capture of `right`, `left` or `both` hands."""
    made: dict[str, Capture] = {}

    def make(hands: str = "right") -> Capture:
        if hands not in made:
            made[hands] = paint_capture(tmp_path_factory.mktemp("painted") / hands, hands)
        return made[hands]

    return make


@pytest.fixture
def make_training(make_painted: Callable[..., Capture], tmp_path: Path) -> TrainingMaker:
    """Return a function that opens what a method is given of a painted capture."""

    def make(hands: str = "right", **settings: object) -> TrainingCapture:
        capture = make_painted(hands)
        split = contiguous_split(capture.info.id, FRAMES)
        run = RunSettings({**QUICK, **settings}, 0, Budget())
        return open_request(write_request(tmp_path / f"request-{hands}", capture, split, run))

    return make
