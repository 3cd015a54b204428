"""Fixtures of the baselines that know skin before they see a capture."""

from __future__ import annotations

from pathlib import Path

import pytest

from hwp_bench.capture import Capture
from hwp_bench.methods.contract import TrainingCapture


@pytest.fixture(scope="session")
def turned(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """A stranger's hand: its palm in training frames, its back in test frames."""
    from turned import paint_turned

    return paint_turned(tmp_path_factory.mktemp("turned") / "turned")


@pytest.fixture
def turned_hand(turned: Capture, tmp_path: Path) -> TrainingCapture:
    """The part of it that a method is given."""
    from turned import turned_training

    return turned_training(turned, tmp_path)
