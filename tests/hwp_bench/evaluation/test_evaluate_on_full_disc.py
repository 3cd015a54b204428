"""Evaluations on a disc that is full, for a while or to the end.

Oracle: a small `tmpfs` that the test mounts in namespaces of its own, and the same evaluation with
room. The method fills that disc itself, because only it knows when it renders; it stands for
whatever else may write there.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from small_captures import CaptureMaker
from small_methods import SCRIPT, write_manifest

_METHOD = """
import json, os, pathlib, sys, time
import cv2, numpy as np
request, output = map(pathlib.Path, sys.argv[1:])
here = pathlib.Path(__file__).parent.parent
value = json.loads((request / "request.json").read_text())
filler, marker = pathlib.Path("FILLER"), here / f"ran-{value['id']}"
full = not marker.exists() and value["id"] == "second"
with marker.open("a") as stream:
    stream.write("x")
if full:
    print("before", flush=True)
    with open(filler, "wb", buffering=0) as stream:
        try:
            while True:
                stream.write(bytes(65536))
        except OSError:
            pass
        try:
            while True:
                stream.write(b"0")
        except OSError:
            pass
    PRINT
    time.sleep(0.7)
(output / "predictions").mkdir(parents=True, exist_ok=True)
for frame in range(*value["split"]["test"]):
    level = np.full((value["height"], value["width"], 3), 90, np.uint8)
    cv2.imwrite(str(output / "predictions" / f"{frame:06d}.png"), level)
if full and "STAYS" == "no":
    filler.unlink()
"""
_STEPS = """
import contextlib, io, json, pathlib, sys
from hwp_bench.cli.main import main
disc, method, *captures = map(pathlib.Path, sys.argv[1:])
words = ["evaluate", str(method), "-o", str(disc / "runs" / "out"), "--isolation", "none"]
words += ["--time-limit", "60"]
for capture in captures:
    words += ["--capture", str(capture)]
told = []
for start in range(2):
    errors = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(errors):
        status = main(words)
    file = disc / "runs" / "out" / "results.json"
    failures = None
    if file.is_file():
        failures = {one["id"]: one["failure"] for one in json.loads(file.read_text())["captures"]}
    told.append({"status": status, "said": errors.getvalue(), "failures": failures})
    (disc / "filler").unlink(missing_ok=True)
runs = {path.name: len(path.read_text()) for path in method.parent.glob("ran-*")}
print(json.dumps({"starts": told, "runs": runs}))
"""
_MOUNT = 'mount -t tmpfs -o size=16m none "$1" && exec "$2" -c "$3" "$1" "$4" "$5" "$6"'


@pytest.fixture
def evaluated(make_capture: CaptureMaker, tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """Evaluate two captures twice on a small disc, which the method fills on the second."""

    def run(stays: bool, printed: str = "") -> dict[str, Any]:
        method, disc = tmp_path / "filler", tmp_path / "disc"
        for folder in (method, disc):
            folder.mkdir()
        script = _METHOD.replace("PRINT", printed or "pass").replace("FILLER", f"{disc}/filler")
        (method / "run.py").write_text(script.replace("STAYS", "yes" if stays else "no"))
        write_manifest(method, "filler", SCRIPT)
        captures = [make_capture(name, frames=20, size=32).root for name in ("first", "second")]
        walls = ["unshare", "--user", "--map-root-user", "--mount"]
        if subprocess.run([*walls, "true"], check=False, capture_output=True).returncode:
            pytest.skip("no user namespaces on this machine")
        done = subprocess.run(
            [*walls, "sh", "-c", _MOUNT, "sh", disc, sys.executable, _STEPS, method, *captures],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout.splitlines()[-1])

    return run


def test_a_disc_that_is_full_for_a_while_is_not_held_against_a_method(
    evaluated: Callable[..., dict[str, Any]],
) -> None:
    told = evaluated(stays=False)
    full, room = told["starts"]
    assert full["status"] == 1
    assert full["failures"]["first"] is None
    assert "disc of its output" in full["failures"]["second"]
    assert "start again" in full["failures"]["second"]
    assert room["status"] == 0
    assert room["failures"] == {"first": None, "second": None}
    assert told["runs"] == {"ran-first": 1, "ran-second": 2}


def test_a_disc_that_stays_full_ends_in_one_message_and_what_is_finished_stays(
    evaluated: Callable[..., dict[str, Any]],
) -> None:
    told = evaluated(stays=True)
    full, room = told["starts"]
    assert full["status"] == 1
    errors = [line for line in full["said"].splitlines() if "error" in line]
    assert len(errors) == 1
    assert "Traceback" not in full["said"]
    assert "out/captures/.unfinished/second" in errors[0]
    assert "No space left" in errors[0]
    assert "free space" in errors[0] or "Make room" in errors[0]
    assert full["failures"] is None
    assert room["status"] == 0
    assert room["failures"] == {"first": None, "second": None}
    assert told["runs"] == {"ran-first": 1, "ran-second": 2}


def test_a_method_that_prints_while_the_disc_is_full_ends(
    evaluated: Callable[..., dict[str, Any]],
) -> None:
    """It had stood still until its time limit, because nobody read what it printed."""
    told = evaluated(stays=False, printed='print("y" * 300_000, flush=True)')
    assert "out of time" not in told["starts"][0]["failures"]["second"]
    assert "disc of its output" in told["starts"][0]["failures"]["second"]
    assert told["starts"][1]["status"] == 0
