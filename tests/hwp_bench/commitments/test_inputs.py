"""From the inputs to a score with a program that knows nothing of the toolkit.

Oracle: a program that copies the frame before the test part, and the score of the same pixels.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from small_captures import CaptureMaker

from hwp_bench.api import score
from hwp_bench.base.images import pixel_digest, read_rgb
from hwp_bench.capture import Capture
from hwp_bench.cli.main import main
from hwp_bench.results import read_results

# Only the standard library: what an author of any program finds in the folder is enough.
PROGRAM = """
import json, pathlib, shutil, sys
inputs = pathlib.Path(sys.argv[1])
for request in sorted((inputs / "requests").iterdir()):
    first, last = json.loads((request / "request.json").read_text())["split"]["test"]
    for frame in range(first, last):
        shutil.copy(request / "frames" / f"{first - 1:06d}.png",
                    inputs / "submission" / "predictions" / request.name / f"{frame:06d}.png")
"""


@pytest.fixture
def captures(make_capture: CaptureMaker) -> list[Capture]:
    return [make_capture("capture0", truth=True, size=48), make_capture("capture4", size=48)]


def test_a_program_of_ones_own_is_scored_by_two_commands(
    captures: list[Capture], tmp_path: Path, capsys
) -> None:
    inputs, out = tmp_path / "in puts", tmp_path / "out"
    roots = [str(capture.root) for capture in captures]
    words = ["data", "inputs", "--capture", *roots, "-o", str(inputs), "--name", "copier"]
    assert main([*words, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["frames"] == {"capture0": 2, "capture4": 2}
    subprocess.run([sys.executable, "-I", "-c", PROGRAM, str(inputs)], check=True)
    program, *command = shlex.split(said["score"])
    assert program == "hwp-bench"
    assert said["score"] in (inputs / "README.md").read_text()
    assert main([*command, "--out", str(out)]) == 0
    results = read_results(out)
    assert results.method.name == "copier"
    for result, capture in zip(results.captures, captures, strict=True):
        for frame in result.frames:
            mask, exact = capture.scoring_mask(frame.frame)
            drawn = capture.frame(17)
            expected = score(drawn, capture.frame(frame.frame), mask, exact=exact)
            assert frame.scores["psnr"] == pytest.approx(expected["psnr"], abs=1e-12)


def test_the_inputs_hold_no_test_frame_and_no_truth(
    captures: list[Capture], tmp_path: Path
) -> None:
    inputs = tmp_path / "inputs"
    assert main(["data", "inputs", "--capture", str(captures[0].root), "-o", str(inputs)]) == 0
    hidden = {pixel_digest(captures[0].frame(frame)) for frame in (18, 19)}
    images = sorted(inputs.rglob("*.png"))
    assert len(images) == 2 * 18
    assert not hidden & {pixel_digest(read_rgb(image)) for image in images}
    assert not list(inputs.rglob("*truth*"))
    assert "| capture0 | 48 x 48 | 18 | 19 | 0 |" in (inputs / "README.md").read_text()


def test_a_suite_is_taken_by_name(
    captures: list[Capture], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    asked = []

    def ensure(name: str) -> list[Path]:
        asked.append(name)
        return [capture.root for capture in captures]

    monkeypatch.setattr("hwp_bench.suites.suite.ensure_suite", ensure)
    inputs = tmp_path / "inputs"
    assert main(["data", "inputs", "--suite", "smoke", "-o", str(inputs)]) == 0
    assert f"evaluate {inputs / 'submission'} --suite smoke" in capsys.readouterr().out
    # What exists, and a wrong name, are said before anything is rendered.
    assert main(["data", "inputs", "--suite", "smoke", "-o", str(inputs)]) == 2
    assert "exists already" in capsys.readouterr().err
    other = str(tmp_path / "other")
    assert main(["data", "inputs", "--suite", "smoke", "-o", other, "--name", "a b"]) == 2
    assert asked == ["smoke"]
