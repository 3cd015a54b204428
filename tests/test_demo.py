"""The README's first command ends in tables and pictures, and again at once from the cache."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hwp_bench.capture import Capture, open_capture
from hwp_bench.splits import contiguous_split


def flat_colour_score(capture: Capture) -> float:
    """Mean PSNR of test frames whose hand is painted in its true mean colour."""
    scores = []
    for frame in contiguous_split(capture.info.id, len(capture)).test.tolist():
        hand = capture.true_mask(frame) == 255
        pixels = capture.frame(frame)[hand] / 255.0
        scores.append(-10 * np.log10(((pixels - pixels.mean(axis=0)) ** 2).mean()))
    return float(np.mean(scores))


@pytest.mark.slow
def test_the_demo_renders_fits_scores_and_draws(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    command = [sys.executable, "-m", "hwp_bench.cli.main", "demo", "--out", str(out)]
    environment = {**os.environ, "HWP_CACHE": str(tmp_path / "cache")}
    first = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert first.returncode == 0, first.stderr
    assert "Plain fit" in first.stdout
    assert "Time of this demo" in first.stdout
    results = json.loads((out / "results.json").read_text())
    rendered = map(open_capture, (tmp_path / "cache").glob("sim/captures/*/"))
    captures = {capture.info.id: capture for capture in rendered}
    assert [capture["id"] for capture in results["captures"]] == ["capture0", "capture4"]
    for capture in results["captures"]:
        assert capture["exact_masks"]
        assert capture["curve"]
        scores = [frame["scores"]["psnr"] for frame in capture["frames"]]
        # The hand in its own mean colour, frame by frame, is more than an unfitted avatar knows.
        assert np.mean(scores) > flat_colour_score(captures[capture["id"]]) + 1
        assert (out / "captures" / capture["id"] / "pictures" / "comparison.png").is_file()
    again = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert json.loads((out / "results.json").read_text())["captures"] == results["captures"]
    assert "Rendering" not in again.stderr
