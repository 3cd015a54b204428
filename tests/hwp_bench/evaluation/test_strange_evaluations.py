"""Evaluations with numbers, names and pixels that are not what they should be.

Oracle: the exit status, one message, and that whatever was written can be read again.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_captures import CaptureMaker
from small_methods import SCRIPT, write_manifest

from hwp_bench.base.images import write_image
from hwp_bench.capture import Capture
from hwp_bench.cli.main import main
from hwp_bench.results import read_results

_SCRIPT = """
import json, pathlib, sys
import cv2, numpy as np
request, output = map(pathlib.Path, sys.argv[1:])
value = json.loads((request / "request.json").read_text())
for frame in range(*value["split"]["test"]):
    folder = output / "predictions"
    folder.mkdir(parents=True, exist_ok=True)
    level = np.full((value["height"], value["width"], 3), 90, np.uint8)
    cv2.imwrite(str(folder / f"{frame:06d}.png"), level)
(output / "run.json").write_text((pathlib.Path(__file__).parent / "facts.json").read_text())
"""


@pytest.fixture
def capture(make_capture: CaptureMaker) -> Capture:
    return make_capture("tiny", frames=20, size=32)


def claiming(folder: Path, facts: str, more: str = "") -> Path:
    """A method that paints grey and whose `run.json` says what it likes."""
    folder.mkdir(exist_ok=True)
    (folder / "run.py").write_text(_SCRIPT)
    (folder / "facts.json").write_text(facts)
    write_manifest(folder, "claim", SCRIPT, more)
    return folder


@pytest.mark.parametrize(
    ("facts", "status"),
    [
        ('{"fit_seconds": 5e-324, "render_seconds": 5e-324}', 0),
        ('{"fit_seconds": 1.7e308, "render_seconds": 1.7e308}', 1),
        ('{"steps": 18446744073709551616}', 1),
        ('{"device": "\\ud800"}', 1),
    ],
)
def test_whatever_a_method_claims_ends_in_tables(
    capture: Capture, tmp_path: Path, capsys, facts: str, status: int
) -> None:
    """Numbers that vanish or overflow had ended the evaluation at its tables."""
    out = tmp_path / "out"
    method = claiming(tmp_path / "claim", facts)
    words = ["evaluate", str(method), "--capture", str(capture.root), "-o", str(out)]
    assert main(words) == status
    results = read_results(out)
    assert (results.captures[0].failure is None) == (status == 0)
    assert json.loads((out / "tables" / "overall.json").read_text())["rows"]
    assert main(["table", str(out), "--by", "cost", "--json"]) == 0


@pytest.mark.parametrize(
    ("words", "more", "problem"),
    [
        (["--seed", str(10**30)], "", "seed: "),
        (["--seed", "-1"], "", "seed: "),
        (["--budget", "1e300"], "", "seconds: "),
        (["--steps", str(10**30)], "", "steps: "),
        ([], '[presets.default]\n"a\\u001bb" = 1\n', "control character"),
        ([], '[presets.default]\na = "\\u001b[2J"\n', "control character"),
        ([], f'[presets.default]\na = "{"x" * 20_000}"\n', "10,000 characters"),
        (["--preset", "x" * 2000], f"[presets.{'x' * 2000}]\na = 1\n", "method.preset"),
    ],
)
def test_a_result_that_could_not_be_read_again_is_refused_before_it_is_made(
    capture: Capture, tmp_path: Path, capsys, words: list[str], more: str, problem: str
) -> None:
    out = tmp_path / "out"
    method = claiming(tmp_path / "claim", "{}", more)
    given = ["evaluate", str(method), "--capture", str(capture.root), "-o", str(out), *words]
    assert main(given) in (1, 2)
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert problem in told
    assert not (out / "results.json").exists()


@pytest.mark.parametrize("kind", ["frames", "masks"])
def test_a_capture_that_was_changed_is_not_scored(
    capture: Capture, tmp_path: Path, capsys, kind: str
) -> None:
    """Blackened test frames had been scored under the digest of the pristine capture."""
    method, out = claiming(tmp_path / "claim", "{}"), tmp_path / "out"
    pixels = np.full((32, 32, 3) if kind == "frames" else (32, 32), 255, np.uint8)
    write_image(capture.root / kind / "000018.png", pixels)
    words = ["evaluate", str(method), "--capture", str(capture.root), "-o", str(out)]
    assert main(words) == 1
    assert f"digests.{kind}: does not match the content" in capsys.readouterr().err
    assert not (out / "results.json").exists()
