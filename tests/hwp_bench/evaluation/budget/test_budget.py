"""An error budget end to end. Oracle: a method whose answer is arithmetic on what it is given."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hwp_bench.base.errors import UsageError
from hwp_bench.base.images import read_rgb
from hwp_bench.capture import Capture, CaptureWriter, open_capture
from hwp_bench.capture.schema import TRUE_TEMPLATE, write_subject_mesh
from hwp_bench.cli.main import main
from hwp_bench.evaluation.budget import budget
from hwp_bench.evaluation.budget.budget import plan_variants, run_budget
from hwp_bench.evaluation.budget.corrections import CORRECTIONS
from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
from hwp_bench.methods.contract import RunSettings
from hwp_bench.methods.request import ORACLE_INPUTS

_MANIFEST = """
schema = "hwp-method/1"
training = "none"
name = "mean-color"
title = "Mean colour"
[entry]
python = "mean_color:make"
"""
# It draws the mean colour of what the masks show, and dims it by a given shape parameter.
_CODE = """
import numpy as np


class Avatar:
    def __init__(self, color):
        self.color = color

    def render(self, hands, camera):
        rgba = np.ones((camera.height, camera.width, 4))
        rgba[..., :3] = self.color * np.exp(-hands["right"].betas[0])
        return rgba


class MeanColor:
    def fit(self, training, budget, report):
        colors = [training.frame(f)[training.mask(f) > 127] for f in training.train.tolist()]
        avatar = Avatar(np.concatenate(colors).mean(axis=0) / 255.0)
        report(0, avatar)
        return avatar


def make(settings, seed):
    return MeanColor()
"""


@pytest.fixture
def method(tmp_path: Path) -> Path:
    folder = tmp_path / "mean-color"
    folder.mkdir()
    (folder / "method.toml").write_text(_MANIFEST)
    (folder / "mean_color.py").write_text(_CODE)
    return folder


@pytest.fixture
def dark_capture(make_painted: Callable[..., Capture], tmp_path: Path) -> Capture:
    """The painted hand whose training frames are dark and whose first shape parameter is off."""
    painted = make_painted()
    count = len(painted)
    info = replace(
        painted.info,
        id="dark",
        source={"kind": "test", "importer": {"name": "video", "version": 2}},
        perturbations={"illumination": (3,) * (count * 4 // 5) + (0,) * (count - count * 4 // 5)},
    )
    truth = painted.hands
    off = {side: replace(hand, betas=hand.betas + 0.4) for side, hand in truth.items()}
    with CaptureWriter(tmp_path / "dark", info, off, painted.cameras) as writer:
        for frame in range(count):
            image, mask = painted.frame(frame), painted.mask(frame)
            writer.frame(frame, image // 2 if frame < count * 4 // 5 else image)
            writer.mask(frame, mask)
            writer.clean(frame, image)
            writer.clean_mask(frame, mask)
            writer.true_mask(frame, mask)
        writer.true_hands(truth)
    own = {side: painted.template(side) for side in info.sides}
    write_subject_mesh(tmp_path / "dark" / TRUE_TEMPLATE, own)
    return open_capture(tmp_path / "dark")


def test_each_truth_gains_what_its_error_costs(
    method: Path,
    dark_capture: Capture,
    tmp_path: Path,
    capsys: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "out"
    command = ["error-budget", str(method), "--capture", str(dark_capture.root), "-o", str(out)]
    assert main([*command, "--isolation", "none", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    rows = {row["name"]: row["gain"]["dark"] for row in record["rows"]}
    assert set(rows) >= {*ORACLE_INPUTS, "all of them", "gain", "light", "motion", "pose"}
    # Masks, poses and the mesh do not enter the answer; light and shape do, and both at once most.
    for name in ("masks", "poses", "test-poses", "mesh"):
        assert rows[name] == pytest.approx(0.0, abs=1e-9)
    assert rows["pixels"] > 1.0
    assert rows["betas"] > 1.0
    assert rows["all of them"] > max(rows["pixels"], rows["betas"])
    # One gain makes good what both errors cost: they are one gain.
    assert rows["gain"] == pytest.approx(rows["all of them"], abs=1.0)
    assert rows["light"] >= rows["gain"] - 1e-6
    assert json.loads((out / "budget.json").read_text()) == record
    assert (out / "tables" / "budget.md").is_file()
    picture = read_rgb(out / "budget.png")
    # The truth, the method as it is, six truths and all of them; below the corrections.
    assert picture.shape[1] > 176 * (len(ORACLE_INPUTS) + 3)
    assert picture.shape[0] > 2 * 176
    given = json.loads((out / "runs" / "as-given" / "results.json").read_text())
    assert [capture["made_by"] for capture in given["captures"]] == ["video 2"]
    # Started again it takes what is there; one correction tells as much as all of them.
    monkeypatch.setattr(budget, "CORRECTIONS", {"gain": CORRECTIONS["gain"]})
    stored = sorted(path.stat().st_mtime_ns for path in out.rglob("result.json"))
    assert main([*command, "--isolation", "none"]) == 0
    assert "Most is lost before fitting: " in capsys.readouterr().out
    assert sorted(path.stat().st_mtime_ns for path in out.rglob("result.json")) == stored


def test_truths_that_a_capture_lacks_are_left_out() -> None:
    both = plan_variants([("betas", "poses"), ("betas",)], tuple(ORACLE_INPUTS))
    assert both == {"as given": (), "betas": ("betas",)}
    assert plan_variants([()], tuple(ORACLE_INPUTS)) == {"as given": ()}
    chosen = plan_variants([tuple(ORACLE_INPUTS)], ("poses", "betas"))
    assert list(chosen) == ["as given", "poses", "betas", "all of them"]
    assert chosen["all of them"] == ("poses", "betas")


def test_wrong_requests_are_refused(dark_capture: Capture, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="'light' is not an estimate"):
        run_budget("x", [dark_capture.root], tmp_path, EvaluationSettings(), ["light"])
    oracle = EvaluationSettings(run=RunSettings(frames="clean"))
    with pytest.raises(UsageError, match="is an oracle itself"):
        run_budget("x", [dark_capture.root], tmp_path, oracle)


def test_other_truths_in_the_same_folder_are_refused_before_any_fit(
    method: Path, dark_capture: Capture, tmp_path: Path, capsys: Any
) -> None:
    out = tmp_path / "out"
    words = ["error-budget", str(method), "--capture", str(dark_capture.root), "-o", str(out)]
    words += ["--isolation", "none"]
    assert main([*words, "--truths", "poses", "betas"]) == 0
    before = sorted((out / "runs").iterdir())
    capsys.readouterr()
    # "all of them" would be of other truths.
    assert main(words) == 2
    assert "results of another evaluation: frames" in capsys.readouterr().err
    assert sorted((out / "runs").iterdir()) == before


def test_a_real_capture_has_corrections_alone(
    method: Path, make_painted: Callable[..., Capture], tmp_path: Path, capsys: Any
) -> None:
    command = ["error-budget", str(method), "--capture", str(make_painted().root)]
    assert main([*command, "-o", str(tmp_path / "out"), "--isolation", "none", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert {row["kind"] for row in rows} == {"correction"}
    assert all(np.isfinite(list(row["psnr"].values())).all() for row in rows)
