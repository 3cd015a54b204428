"""Splits with no and with one training frame on the command line of `hwp-bench evaluate`.

Oracles: the message and exit status of bad input; finite scores of every test frame.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest
from small_captures import split_file

from hwp_bench.capture import Capture
from hwp_bench.cli.main import main

PLAIN = str(Path(__file__).parents[3] / "baselines" / "plain")


def evaluate(capture: Capture, train: list[int], folder: Path) -> tuple[int, Path]:
    splits = split_file(folder / "splits.json", capture.info.id, train, len(capture))
    out = folder / "out"
    words = ["evaluate", PLAIN, "--capture", str(capture.root), "--splits", splits]
    words += ["-o", str(out), "--steps", "5", "--isolation", "none"]
    words += ["--set", "gaussians=300", "--set", "device=cpu"]
    return main(words), out


def test_no_training_frame_is_one_message(
    make_painted: Callable[..., Capture], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out = evaluate(make_painted(), [0, 0], tmp_path)
    assert status == 1
    said = capsys.readouterr().err
    assert "train" in said
    assert "no frame is left (0 to 0)" in said
    assert "Traceback" not in said
    assert not out.exists()


@pytest.mark.slow
def test_one_training_frame_gives_finite_scores(
    make_painted: Callable[..., Capture], tmp_path: Path
) -> None:
    status, out = evaluate(make_painted(), [3, 4], tmp_path)
    assert status == 0
    (capture,) = json.loads((out / "results.json").read_text())["captures"]
    assert capture["failure"] is None
    assert len(capture["frames"]) == 2
    for frame in capture["frames"]:
        assert frame["failure"] is None
        assert all(math.isfinite(value) for value in frame["scores"].values())
