"""The README's first command ends in tables and pictures, and again at once from the cache."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest


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
    assert [capture["id"] for capture in results["captures"]] == ["capture0", "capture4"]
    for capture in results["captures"]:
        assert capture["exact_masks"]
        assert capture["curve"]
        # An image of one colour scores about 17 dB here: the fit must have learnt something.
        assert all(frame["scores"]["psnr"] > 20 for frame in capture["frames"])
        assert (out / "captures" / capture["id"] / "pictures" / "comparison.png").is_file()
    again = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert json.loads((out / "results.json").read_text())["captures"] == results["captures"]
    assert "Rendering" not in again.stderr
