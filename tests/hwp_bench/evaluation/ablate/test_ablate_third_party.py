"""An ablation of a method that nobody here wrote. Oracle: what its two lines of fitting must do."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from small_captures import CaptureMaker

from hwp_bench.cli.main import main
from hwp_bench.results import read_results

_MANIFEST = """
schema = "hwp-method/1"
training = "none"
name = "their-method"
title = "Theirs"
[entry]
python = "theirs:make"
[presets.default]
shade = true
[switches.shade]
title = "Shading"
settings_off = {shade = false}
[switches.lazy]
title = "Laziness"
settings_on = {every = 100}
"""

_CODE = """
import numpy as np


class Avatar:
    def __init__(self, level, steps):
        self.level, self.steps = level, steps

    def render(self, hands, camera):
        rgba = np.ones((camera.height, camera.width, 4))
        rgba[..., :3] = self.level
        return rgba


class Theirs:
    def __init__(self, settings):
        self.goal = 0.6 if settings["shade"] else 0.3

    def fit(self, training, budget, report):
        assert budget.seconds == 50.0, budget
        report(0, Avatar(0.0, 0))
        for step in range(1, budget.steps + 1):
            report.progress(step, budget.steps)
            report(step, Avatar(self.goal * step / budget.steps, step))
        return Avatar(self.goal, budget.steps)


def make(settings, seed):
    return Theirs(settings)
"""


@pytest.mark.slow
def test_its_own_switches_and_both_budgets_reach_it(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    method, out = tmp_path / "theirs", tmp_path / "out"
    method.mkdir()
    (method / "method.toml").write_text(_MANIFEST)
    (method / "theirs.py").write_text(_CODE)
    capture = make_capture("tiny", frames=20, size=32)
    words = ["ablate", str(method), "--capture", str(capture.root), "-o", str(out), "--seeds", "1"]
    assert main([*words, "--without", "shade", "--budget", "50", "--steps", "10"]) == 0
    record = json.loads((out / "ablation.json").read_text())
    assert [variant["name"] for variant in record["variants"]] == ["no-shade", "full"]
    assert record["budget"] == {"seconds": 50.0, "steps": 10}
    assert {row["effect"] for row in record["score_effects"]} == {"Shading"}
    for variant in record["variants"]:
        result = read_results(out / variant["results"][0]).captures[0]
        assert result.steps == 10
        # From the unfitted avatar on, every tenth of the budget in steps, and the end.
        assert [point.step for point in result.curve] == list(range(11))
        assert result.curve[0].scores["psnr"] != result.curve[-1].scores["psnr"]
        assert result.job_seconds > result.wall_seconds > result.curve_seconds > 0
