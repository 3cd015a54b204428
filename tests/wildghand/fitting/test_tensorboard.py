"""A fit in TensorBoard. Oracles: tensorboard's own reader; the same fit without it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny_fits import UNJUDGED

import wildghand
from hwp_bench.base.errors import MissingDependency
from hwp_bench.capture import Capture
from hwp_bench.methods.contract import Budget
from wildghand.cli.main import main
from wildghand.fitting import fit_capture
from wildghand.fitting.glance import Live
from wildghand.fitting.tensorboard import logging_fit

QUICK: dict[str, Any] = {**UNJUDGED, "gaussians": 400, "prior": ""}


def test_curves_of_a_fit(make_painted: Callable[..., Capture], tmp_path: Path) -> None:
    capture, looks = make_painted(), []
    with logging_fit(tmp_path / "log", Live(looks.append, pause=0.0), pause=0.0) as watch:
        fit_capture(capture.root, settings=QUICK, budget=Budget(steps=6), watch=watch)
    read = EventAccumulator(str(tmp_path / "log"))
    read.Reload()
    for name, expected in (
        ("fit/loss", [look.loss for look in looks]),
        ("fit/psnr", [look.psnr for look in looks]),
    ):
        points = read.Scalars(name)
        assert [point.step for point in points] == [1, 2, 3, 4, 5, 6]
        np.testing.assert_allclose([point.value for point in points], expected, rtol=1e-6)


def test_one_option_of_a_fit_writes_them_and_changes_nothing(
    make_painted: Callable[..., Capture], tmp_path: Path
) -> None:
    capture, hands = make_painted(), make_painted().hand_poses(3)
    avatar = wildghand.fit(capture, steps=4, settings=QUICK, tensorboard=tmp_path / "log")
    read = EventAccumulator(str(tmp_path / "log"))
    read.Reload()
    assert read.Scalars("fit/loss")[0].step == 1
    alone = wildghand.fit(capture, steps=4, settings=QUICK)
    np.testing.assert_array_equal(avatar.pose(hands).means, alone.pose(hands).means)
    arguments = ["fit", str(capture.root), "-o", str(tmp_path / "avatar"), "--steps", "4"]
    options = [f"--set={name}={value!r}" for name, value in QUICK.items()]
    options = [option.replace("True", "true").replace("False", "false") for option in options]
    assert main([*arguments, *options, "--tensorboard", str(tmp_path / "shell")]) == 0
    read = EventAccumulator(str(tmp_path / "shell"))
    read.Reload()
    assert read.Scalars("fit/loss")[0].step == 1


def test_without_tensorboard_it_is_said_before_the_fit(
    make_painted: Callable[..., Capture], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(MissingDependency, match=r"pip install 'hwp-bench\[tensorboard\]'"):
        wildghand.fit(make_painted(), tmp_path / "avatar", tensorboard=tmp_path / "log")
    assert list(tmp_path.iterdir()) == []
