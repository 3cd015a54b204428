"""The threat model names tests, and a thief of test frames fails. Oracle: the files themselves."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from small_captures import CaptureMaker

from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
from hwp_bench.evaluation.evaluate import evaluate
from hwp_bench.run.sandbox.confinement import Confinement

TESTS = Path(__file__).parent
PAGE = TESTS.parent / "docs" / "threat-model.md"

THIEF = """
import pathlib, shutil, sys
output = pathlib.Path(sys.argv[2])
(output / "predictions").mkdir()
for frame in (18, 19):
    for place in {places!r}:
        source = pathlib.Path(place) / f"{{frame:06d}}.png"
        target = output / "predictions" / source.name
        try:
            shutil.copyfile(source, target)
            break
        except OSError:
            target.unlink(missing_ok=True)
            target.symlink_to(source)
"""


def test_every_test_that_the_page_names_exists() -> None:
    code = {path: path.read_text("utf-8") for path in TESTS.rglob("test_*.py")}
    named = set()
    for file, name in re.findall(
        r"`(?:([\w/]*test_\w+\.py)(?:::(test_\w+))?)`", PAGE.read_text("utf-8")
    ):
        matches = [path for path in code if path.as_posix().endswith(f"/{file}")]
        assert len(matches) == 1, file
        assert not name or f"def {name}(" in code[matches[0]], name
        named.add(file)
    assert len(named) > 15
    for name in re.findall(r"`(test_\w+)`", PAGE.read_text("utf-8")):
        assert sum(f"def {name}(" in text for text in code.values()) == 1, name


def test_a_thief_who_knows_the_way_gets_no_test_frame(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    capture = make_capture("tiny", frames=20, size=32, folder=tmp_path / "method" / "captures")
    method, out = tmp_path / "method", tmp_path / "out"
    # Even a capture inside the method's own folder, which it may read, stays hidden.
    places = [str(capture.root / "frames"), str(out / "captures" / "tiny" / "pictures")]
    (method / "run.py").write_text(THIEF.format(places=places))
    (method / "method.toml").write_text(
        'schema = "hwp-method/1"\ntraining = "none"\nname = "thief"\n[entry]\n'
        'command = ["{python}", "{method}/run.py", "{request}", "{output}"]\n'
    )
    results = evaluate(
        str(method), [capture.root], out, EvaluationSettings(confinement=Confinement("auto"))
    )
    isolation = json.loads((out / "results.json").read_text())["captures"][0]["isolation"]
    if isolation != "namespaces":
        assert isolation.startswith("processes (")
        pytest.skip("no user namespaces on this machine")
    frames = results.captures[0].frames
    assert all("does not exist" in (frame.failure or "") for frame in frames)
    # The same method without a sandbox does steal: the test can fail.
    bare = EvaluationSettings(confinement=Confinement("none"))
    stolen = evaluate(str(method), [capture.root], tmp_path / "bare", bare).captures[0]
    assert stolen.isolation == "processes"
    assert stolen.failed_frames == 0
    # What was made without a sandbox is no result where one is required.
    strict = EvaluationSettings(confinement=Confinement("required"))
    again = evaluate(str(method), [capture.root], tmp_path / "bare", strict).captures[0]
    assert again.isolation == "namespaces"
    assert again.failed_frames == len(again.frames)
