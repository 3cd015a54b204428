"""`new` and `check-method`. Oracle: each kind that is written runs and is scored; a method with a
known fault is told of that fault, and of no other."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_methods import SCRIPT, write_manifest, write_submission

from hwp_bench.base.errors import HwpError
from hwp_bench.capture import Capture
from hwp_bench.cli.main import main
from hwp_bench.evaluation import check_method as checks
from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
from hwp_bench.evaluation.evaluate import evaluate
from hwp_bench.methods.contract import Budget, RunSettings
from hwp_bench.methods.template import write_method
from hwp_bench.run.sandbox.confinement import Confinement
from hwp_bench.run.worker import Watch, read_findings

KINDS = ("mean", "mesh", "torch", "command")
CLASS = """
import numpy as np
class Mine:
    def __init__(self, settings, seed):
        MADE
    def fit(self, training, budget, report):
        FIT
        return self
    def render(self, hands, camera):
        image = np.full((camera.height, camera.width, 3), 0.5)
        RENDER
        return image
"""


@pytest.fixture(scope="module")
def both(make_painted: Callable[[str], Capture]) -> Capture:
    return make_painted("both")


def python_method(folder: Path, **parts: str) -> Path:
    write_manifest(folder, folder.name, 'python = "mine:Mine"')
    code = CLASS
    for name in ("MADE", "FIT", "RENDER"):
        code = code.replace(name, parts.get(name.lower(), "pass"))
    (folder / "mine.py").write_text(code)
    return folder


def check(method: Path, capture: Capture, capsys: Any, *words: str) -> tuple[int, dict[str, Any]]:
    status = main(["check-method", str(method), "--capture", str(capture.root), "--json", *words])
    return status, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("kind", KINDS)
def test_what_new_writes_is_sound_and_is_scored(
    kind: str, both: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new", "3d-hand", "--kind", kind]) == 0
    said = capsys.readouterr()
    assert said.err == "next: hwp-bench check-method 3d-hand\n"
    for file in said.out.split():
        assert Path(file).is_file()
    status, report = check(Path("3d-hand"), both, capsys, "--budget=1000")
    assert report["findings"] == []
    assert status == 0
    asked = EvaluationSettings(run=RunSettings({"steps": 5}))
    results = evaluate("3d-hand", [both.root], Path("out"), asked)
    assert results.method.name == "3d-hand"
    # Black would have 8.5 dB.
    assert np.mean([frame.scores["psnr"] for frame in results.captures[0].frames]) > 15


def test_pictures_that_were_drawn_elsewhere_are_checked_and_scored(
    both: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new", "mine", "--kind", "predictions"]) == 0
    assert "python mine/draw.py inputs/requests" in capsys.readouterr().err
    capture = ["--capture", str(both.root)]
    assert main(["data", "inputs", *capture, "-o", "inputs"]) == 0
    # The public part of a challenge has a manifest next to the requests.
    assert main(["challenge", "publish", str(both.root), "-o", "exam"]) == 0
    assert main(["check-method", "mine"]) == 2
    assert "--suite SUITE or --capture PATH" in capsys.readouterr().err
    status, report = check(Path("mine"), both, capsys)
    assert (status, [one["field"] for one in report["findings"]]) == (1, ["missing"])
    for requests in ("exam/public", "inputs/requests"):
        shutil.rmtree("mine/predictions", ignore_errors=True)
        subprocess.run([sys.executable, "mine/draw.py", requests], check=True)
        assert [path.name for path in Path("mine/predictions").iterdir()] == [both.info.id]
    status, report = check(Path("mine"), both, capsys)
    assert (status, report["findings"]) == (0, [])
    assert main(["evaluate", "mine", *capture, "-o", "out"]) == 0


@pytest.mark.parametrize("name", ["numpy", "torch", "class", "a b", "-x"])
def test_a_name_that_cannot_work_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(HwpError):
        write_method(tmp_path / name, "mean")
    assert not (tmp_path / name).exists()


def test_a_folder_that_holds_something_is_left_as_it_is(tmp_path: Path, capsys) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes").write_text("x")
    assert main(["new", str(tmp_path / "mine")]) == 2
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes"]


FAULTS = {
    "shape": {"render": "image = image[:, :-1]"},
    "type": {"render": "image = image.astype(complex)"},
    "range": {"render": "image = image * 255"},
    "nan": {"render": "image[0, 0] = np.nan"},
    "run": {"render": "raise KeyError(len(hands))"},
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_pictures_is_named(fault: str, both: Capture, tmp_path: Path, capsys) -> None:
    method = python_method(tmp_path / "m", **FAULTS[fault])
    status, report = check(method, both, capsys)
    assert status == 1
    found = {one["field"]: one for one in report["findings"]}
    assert set(found) == {fault}
    assert "frame 3" in found[fault]["where"]
    assert {"shape": "(64, 63, 3)", "range": "128", "run": "KeyError: 2"}.get(fault, "") in (
        found[fault]["problem"]
    )


def test_several_faults_are_listed_together(both: Capture, tmp_path: Path, capsys) -> None:
    parts = {"render": "image[0] = np.nan if camera.K[0, 2] else 2; self.n = 1"}
    parts["fit"] = "import socket; socket.getaddrinfo if 0 else None; self.look(socket)"
    method = python_method(tmp_path / "m", **parts)
    text = (method / "mine.py").read_text()
    text += (
        "    def look(self, socket):\n"
        "        socket.create_server(('127.0.0.1', 0)).close()\n"
        "        try:\n            socket.create_connection(('192.0.2.1', 80), timeout=0.1)\n"
        "        except OSError:\n            pass\n"
    )
    (method / "mine.py").write_text(text)
    _, report = check(method, both, capsys)
    found = {one["field"]: one for one in report["findings"]}
    assert set(found) == {"nan", "network"}
    assert found["network"]["where"].endswith("192.0.2.1")
    assert "--expose" in found["network"]["remedy"]


@pytest.mark.parametrize(
    ("script", "fault", "words"),
    [
        ("", "missing", "does not exist"),
        ("write(np.zeros((8, 8, 3)))", "shape", "is 8x8 pixels where 64x64"),
        ("write(np.ones((64, 64, 3)))", "range", "multiplied by 255"),
        ("write(np.full((64, 64, 3), 90)); sys.exit('no luck')", "run", "no luck"),
        ("sys.exit('curl: (6) Could not resolve host: example.org')", "network", "resolve"),
        (
            "[p.write_bytes(b'x') for p in write(np.zeros((64, 64, 3)))]",
            "image",
            "is not a PNG",
        ),
    ],
    ids=["missing", "shape", "range", "run", "network", "image"],
)
def test_a_fault_of_a_command_is_named(
    script: str, fault: str, words: str, both: Capture, tmp_path: Path, capsys
) -> None:
    method = write_manifest(tmp_path / "m", "m", SCRIPT)
    (method / "run.py").write_text(
        "import json, pathlib, sys\nimport numpy as np\nfrom PIL import Image\n"
        "request, output = map(pathlib.Path, sys.argv[1:])\n"
        "test = json.loads((request / 'request.json').read_text())['split']['test']\n"
        "def write(image):\n"
        "    (output / 'predictions').mkdir()\n"
        "    places = [output / 'predictions' / f'{n:06d}.png' for n in range(*test)]\n"
        "    for place in places:\n"
        "        Image.fromarray(image.astype(np.uint8)).save(place)\n"
        "    return places\n" + script + "\n"
    )
    status, report = check(method, both, capsys)
    assert status == 1
    found = {one["field"]: one["problem"] for one in report["findings"]}
    assert words in found.pop(fault)
    assert set(found) <= {"run"}


def test_a_link_and_a_missing_picture_of_a_submission_are_named(
    both: Capture, tmp_path: Path, capsys
) -> None:
    picture = np.full((64, 64, 3), 90, np.uint8)
    images = {f"{both.info.id}/{frame:06d}.png": picture for frame in (22, 23)}
    method = write_submission(tmp_path / "m", images)
    _, report = check(method, both, capsys)
    (found,) = report["findings"]
    assert found["field"] == "missing"
    assert "22" not in found["where"]


def settings(**more: Any) -> EvaluationSettings:
    run = RunSettings({}, budget=Budget(seconds=0.1, steps=5))
    return EvaluationSettings(run=run, **more)


def faults(method: Path, capture: Capture, asked: EvaluationSettings) -> dict[str, Any]:
    from hwp_bench.commitments.publication import open_captures

    report = checks.check_method(method, open_captures([capture.root], None), asked)
    return {one.field: one for one in report.findings}


def test_what_takes_long_or_much_is_named(
    both: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fit that sleeps longer than its budget; limits that every process passes."""
    monkeypatch.setattr(checks, "_GRACE_SECONDS", 0.0)
    monkeypatch.setattr(checks, "_MUCH_MEMORY", 1e6)
    slow = python_method(tmp_path / "slow", fit="import time; time.sleep(1); report(9, self)")
    found = faults(slow, both, settings())
    assert set(found) == {"speed", "memory"}
    assert all(one.level == "warning" for one in found.values())
    assert faults(slow, both, settings(time_limit=0.1))["speed"].level == "error"
    big = python_method(tmp_path / "big", fit="import time; x = np.ones(10**8); time.sleep(60)")
    walls = Confinement(memory_limit=4 * 10**8)
    assert faults(big, both, settings(confinement=walls))["memory"].level == "error"


def test_a_broken_manifest_is_in_the_report(both: Capture, tmp_path: Path, capsys) -> None:
    method = python_method(tmp_path / "m")
    (method / "method.toml").write_text('schema = "hwp-method/1"\nname = "m"\n')
    status, report = check(method, both, capsys)
    assert (status, report["ok"]) == (1, False)
    assert "trained on" in report["findings"][0]["problem"]


def test_a_method_that_cannot_be_made_is_in_the_report(
    both: Capture, tmp_path: Path, capsys
) -> None:
    method = python_method(tmp_path / "m", made="import not_there")
    assert main(["check-method", str(method), "--capture", str(both.root)]) == 1
    said = capsys.readouterr()
    assert "1 things wrong" in said.out
    assert "not_there" in said.out
    assert "next:" not in said.err


def test_findings_of_a_methods_own_are_not_believed(both: Capture, tmp_path: Path) -> None:
    script = "import pathlib, sys; pathlib.Path(sys.argv[2], 'findings.json').write_text('{}')"
    method = write_manifest(tmp_path / "m", "m", SCRIPT)
    (method / "run.py").write_text(script)
    assert "findings.json" in faults(method, both, settings())["run"].problem
    assert read_findings(tmp_path / "nowhere.json") == {}


@pytest.mark.parametrize(
    ("event", "arguments", "heard"),
    [
        ("socket.getaddrinfo", ("example.org", 80, 0, 0, 0), True),
        ("socket.connect", (None, ("192.0.2.1", 80)), True),
        ("socket.sendto", (None, ("2001:db8::1", 80, 0, 0)), True),
        ("socket.getaddrinfo", ("localhost", 80, 0, 0, 0), False),
        ("socket.connect", (None, ("127.0.0.1", 80)), False),
        ("socket.connect", (None, "/run/socket"), False),
        ("socket.getaddrinfo", (None, 80, 0, 0, 0), False),
        ("open", ("example.org", "r", 0), False),
    ],
)
def test_only_other_machines_are_the_network(
    event: str, arguments: tuple[Any, ...], heard: bool
) -> None:
    watch = Watch()
    watch.hear(event, arguments)
    assert bool(watch.found) == heard


def test_the_toy_capture_is_small_and_shows_both_hands() -> None:
    from hwp_bench.capture import open_capture

    capture = open_capture(checks.toy_capture())
    assert (len(capture), capture.size) == (20, (64, 64))
    assert capture.info.sides == ("right", "left")
    assert capture.free_view is not None
