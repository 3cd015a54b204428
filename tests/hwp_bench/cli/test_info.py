"""`hwp-bench info`. Oracles: the system's tables, files made here, checks of known results."""

from __future__ import annotations

import json
import platform
import sys
import types
from importlib import metadata
from pathlib import Path

import pytest

from hwp_bench.cli.main import main
from hwp_bench.run.sandbox.supervise import ProcessOutcome
from hwp_bench.stability import Case, Measured
from hwp_bench.tracking.networks import HAND, PALM, models_folder


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of 3,000 bytes below the home folder."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("HWP_CACHE", str(tmp_path / "kept"))
    (tmp_path / "kept" / "deep").mkdir(parents=True)
    (tmp_path / "kept" / "deep" / "file").write_bytes(bytes(3000))
    return tmp_path / "kept"


def offer(monkeypatch: pytest.MonkeyPatch, *cases: Case) -> None:
    """Put cases in the place of those of installed packages."""
    module = types.ModuleType("offered")
    module.cases = lambda: list(cases)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "offered", module)
    points = [types.SimpleNamespace(name="offered", value="offered:cases")] if cases else []
    monkeypatch.setattr("hwp_bench.stability.metadata.entry_points", lambda group: points)


def case(passed: bool, *, quick: bool = True) -> Case:
    backends = ("reference", "fast")
    return Case("one", "drawing", "right", lambda _: Measured(passed, "off by 3"), backends, quick)


@pytest.mark.slow
@pytest.mark.usefixtures("machine_code")
def test_the_rasterizer_of_this_machine_is_right(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["python"] == platform.python_version()
    for name in ("torch", "numpy", "opencv-contrib-python-headless"):
        assert facts["packages"][name] == metadata.version(name)
    (total,) = (
        line.split()[1]
        for line in Path("/proc/meminfo").read_text().splitlines()
        if line.startswith("MemTotal")
    )
    assert facts["memory"] == int(total) * 1024
    checks = {row["backend"]: row["passed"] for row in facts["checks"]}
    assert checks["numba"]
    assert "reference" not in checks


def test_cache_tracker_and_sandbox_are_described(
    cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    offer(monkeypatch)
    refused = ProcessOutcome(None, refused="no user namespaces")
    monkeypatch.setattr("hwp_bench.run.runner.run_confined", lambda *_: refused)
    assert main(["info", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["cache"], facts["cache_size"]) == ("~/kept", 3000)
    assert facts["sandbox"] == "not available (no user namespaces)"
    assert "downloaded on first use" in facts["tracker"]
    assert facts["checks"] == []
    models_folder().mkdir(parents=True)
    for name in (PALM, HAND):
        (models_folder() / name).touch()
    monkeypatch.setattr("hwp_bench.run.runner.run_confined", lambda *_: ProcessOutcome(0))
    assert main(["info"]) == 0
    rows = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert rows["sandbox"] == "available"
    assert "networks are in the cache" in rows["tracker"]


@pytest.mark.parametrize(("passed", "status"), [(True, 0), (False, 1)])
def test_the_status_is_that_of_the_quick_checks(
    *,
    passed: bool,
    status: int,
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    offer(monkeypatch, case(passed), case(False, quick=False))
    assert main(["info"]) == status
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.split(maxsplit=2)[:2] == ["drawing", "(fast)"]
    assert ("WRONG, must be: right" in line) != passed
    assert main(["info", "--json"]) == status
    (check,) = json.loads(capsys.readouterr().out)["checks"]
    assert check["passed"] == passed


def test_a_user_without_a_home_and_a_file_that_vanishes(
    cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    offer(monkeypatch, Case("one", "alpha", "holds", lambda _: Measured(True, "fine")))

    def none() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", none)
    (cache / "gone").symlink_to("nowhere")
    assert main(["info", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["cache"], facts["cache_size"]) == (str(cache), 3000)
