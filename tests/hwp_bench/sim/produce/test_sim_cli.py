"""`hwp-bench sim`: results on stdout, one clear line for what is asked wrongly."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from tiny_scene import SINGLE, SceneMaker

from hwp_bench.base.errors import UsageError
from hwp_bench.cli.main import main
from hwp_bench.cli.sim import _changed
from hwp_bench.sim import scene_files
from hwp_bench.sim.produce.calibration import TARGETS, Calibration, calibrate, write_strengths
from hwp_bench.sim.scene.scene import clean_share
from hwp_bench.sim.scene_files import known_scenes, load_scene, scene_groups, scene_names


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.toml"
    path.write_text(SINGLE)
    return path


def test_list_names_scenes_and_parts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "scenes", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert [scene["scene"] for scene in content["scenes"]] == list(known_scenes())
    assert len(content["scenes"]) == 11 + sum(len(scene_names(name)) for name in scene_groups())
    assert content["scenes"][0]["digest"] == load_scene("capture0").digest
    assert main(["list", "scene-parts", "--json"]) == 0
    (parts,) = json.loads(capsys.readouterr().out).values()
    assert "phone" in {row["part"]: row["names"] for row in parts}["objects"]


def test_plan_counts_without_rendering(
    scene_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["dev", "plan", str(scene_file), "--frame-count", "40", "--no-probe", "--json"]
    assert main(command) == 0
    (report,) = json.loads(capsys.readouterr().out)
    assert report["passes"]["hands"] == 40
    assert report["seconds"] is None


def test_the_clean_share_is_that_of_the_severity_asked_for() -> None:
    # Oracle: the share as it is measured.
    scene = _changed(load_scene("persistent-2"), 0.3, 2.0)
    assert scene.clean_share == 0.3
    assert clean_share(scene) == pytest.approx(0.3, abs=0.01)
    with pytest.raises(UsageError, match=r"severity from 1\.5 on"):
        _changed(scene, 0.1, 1.0)


def test_render_and_preview(
    scene_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "capture"
    extent = ["--frame-count", "10", "--size", "32", "--severity", "2", "--workers", "1"]
    extent += ["--no-free-view"]
    assert main(["sim", "render", str(scene_file), "-o", str(out), *extent]) == 0
    assert (out / "capture.json").is_file()
    assert main(["sim", "render", str(scene_file), "-o", str(out), *extent]) == 2
    assert "exists" in capsys.readouterr().err
    command = ["sim", "preview", str(scene_file), "-o", str(tmp_path), "--frame-count", "10"]
    assert main([*command, "--size", "32"]) == 0
    assert (tmp_path / "tiny-sheet.png").is_file()
    assert (tmp_path / "tiny.gif").read_bytes()[:4] == b"GIF8"


@pytest.mark.parametrize(
    "words",
    [
        ["sim", "render"],
        ["sim", "render", "capture0"],
        ["sim", "render", "capture99", "-o", "x"],
        ["sim", "render", "capture0", "--suite", "mini"],
        ["sim", "render", "--suite", "mini", "--size", "64"],
        ["sim", "render", "--suite", "smoke", "--overwrite"],
        ["dev", "calibrate", "wild-dev-7", "--effect", "blur"],
        ["sim", "render", "capture0", "-o", "x", "--severity", "9"],
        ["sim", "preview", "capture0", "--frame-count", "1"],
        ["sim", "preview", "capture0", "--stage", "--size", "64"],
        ["sim", "render", "capture0", "-o", "x", "--seed", "-1"],
        ["sim", "render", "capture0", "-o", "x", "--seed", str(2**63)],
        ["sim", "render", "capture0", "-o", "x", "--subject", str(2**63)],
        # Numbers that no memory holds.
        *(
            [*words, f"{option}={value}"]
            for words in (["dev", "plan", "capture0"], ["sim", "render", "capture0", "-o", "x"])
            for option, value in (
                ("--frame-count", "1" * 60),
                ("--frame-count", "100001"),
                ("--frame-count", "-1"),
                ("--size", "9" * 30),
            )
        ),
    ],
)
def test_wrong_requests_end_with_status_2(
    words: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    if "--severity" in words or any("=" in word for word in words):
        assert "is not in" in error
    assert list(tmp_path.iterdir()) == []


def test_calibration_finds_the_stated_loss(make_scene: SceneMaker) -> None:
    # Dimming has a closed relation of strength and loss, so the solved losses are close.
    scene = make_scene()
    call = scene.effect("illumination")
    assert call is not None
    result = calibrate(scene, call, size=40)
    assert list(result.strengths) == sorted(result.strengths)
    np.testing.assert_allclose(result.measured, TARGETS["illumination"], atol=0.7)


def test_the_digest_is_that_of_the_written_strengths(
    scene_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(scene_files, "known_scenes", lambda: ("tiny",))
    monkeypatch.setattr(scene_files, "scene_path", lambda name: scene_file)
    found = Calibration("illumination", "psnr", (0.1, 0.2, 0.3, 0.4, 0.5), (1.0,) * 5, (1.0,) * 5)
    monkeypatch.setattr("hwp_bench.sim.produce.calibration.calibrate", lambda *_: found)
    scene_files._shipped_scene.cache_clear()
    try:
        words = ["dev", "calibrate", "tiny", "--effect", "illumination", "--write", "--json"]
        assert main(words) == 0
    finally:
        scene_files._shipped_scene.cache_clear()
    (row,) = json.loads(capsys.readouterr().out)
    assert row["digest"] == load_scene(scene_file).digest


@pytest.mark.parametrize("first", [True, False])
def test_strengths_are_replaced_wherever_the_effect_has_them(scene_file: Path, first: bool) -> None:
    kind, old = 'kind = "illumination"\n', "strengths = [\n  0.1, 0.2, 0.3,\n  0.4, 0.5,\n]\n"
    text = scene_file.read_text()
    assert text.count(kind) == 1
    head, tail = text.split(kind)
    own, *others = re.split(r"^(?=\[)", tail, flags=re.MULTILINE)
    own = re.sub(r"^strengths = .*\n", "", own, flags=re.MULTILINE)
    table = old + kind + own if first else kind + own.rstrip("\n") + "\n" + old
    scene_file.write_text(head + table + "".join(others))
    item = Calibration("illumination", "psnr", (0.2, 0.3, 0.4, 0.5, 0.6), (1.0,) * 5, (1.0,) * 5)
    write_strengths(scene_file, [item])
    call = load_scene(scene_file).effect("illumination")
    assert call is not None
    assert call.strengths == item.strengths


def test_strengths_are_written_into_the_file(scene_file: Path) -> None:
    item = Calibration("illumination", "psnr", (0.1, 0.2, 0.3, 0.4, 0.5), (1.0,) * 5, (1.0,) * 5)
    write_strengths(scene_file, [item])
    write_strengths(scene_file, [item])  # a second time replaces
    assert scene_file.read_text().count("strengths = ") == 1
    call = load_scene(scene_file).effect("illumination")
    assert call is not None
    assert call.strengths == item.strengths
    rest = {key: value for key, value in tomllib.loads(SINGLE).items() if key != "effects"}
    assert rest.items() <= tomllib.loads(scene_file.read_text()).items()
