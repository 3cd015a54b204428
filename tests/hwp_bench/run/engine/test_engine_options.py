"""The arguments of engines. Oracles: one line on standard error, exit statuses, bounded waits."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import pytest
from engine_jobs import write_gray_method
from small_captures import CaptureMaker

from hwp_bench.base.errors import HwpError
from hwp_bench.cli.main import main
from hwp_bench.run.engine import ray as ray_connect

WRONG = (
    (["--engine", "slurm"], "'slurm' is not an engine"),
    (["--engine", "ray://"], "'ray://' is not an engine"),
    (["--engine", "local://x"], "is not an engine"),
    (["--jobs", "0"], "--jobs: 0 is not between"),
    (["--job-cpus", "0"], "--job-cpus"),
    (["--job-gpus", "nan"], "--job-gpus"),
    (["--engine", "ray", "--jobs", "2"], "--jobs: works only with --engine local"),
)


@pytest.mark.parametrize(
    "command", [["evaluate", "plain", "--capture", "x"], ["sim", "render", "capture0", "-o", "x"]]
)
def test_wrong_engines_are_named(command, capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for words, problem in WRONG:
        assert main([*command, *words]) == 2
        error = capsys.readouterr().err
        assert problem in error
        assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_without_ray_the_remedy_is_named(capsys, monkeypatch, tmp_path) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.chdir(tmp_path)
    assert main(["evaluate", "plain", "--capture", "x", "--engine", "ray"]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "Ray is not installed. Install it with `pip install 'hwp-bench[ray]'`" in error


@pytest.mark.parametrize(
    ("text", "address"),
    [("h:1", "h:1"), ("10.0.0.1", "10.0.0.1:6379"), ("ray://h:7", "h:7"), (None, None)],
)
def test_addresses_have_a_port(text, address, monkeypatch) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    assert ray_connect.head_address(text) == address
    monkeypatch.setenv("RAY_ADDRESS", "ray://other:9")
    assert ray_connect.head_address(None) == "other:9"


@pytest.mark.parametrize("text", ["", ":1", "h:", "h:x", "h:70000", "http://h:1"])
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(HwpError, match="is not HOST:PORT"):
        ray_connect.head_address(text)


def test_nobody_at_the_address_is_said_in_bounded_time(monkeypatch) -> None:
    with pytest.raises(
        HwpError, match=r"there is no Ray head at 127\.0\.0\.1:1 \(Connection refused\)"
    ):
        ray_connect.check_head("127.0.0.1:1")
    with pytest.raises(HwpError, match=r"there is no Ray head at nowhere\.invalid:6379"):
        ray_connect.check_head("nowhere.invalid:6379")
    # Somebody listens who is not a Ray head.
    monkeypatch.setattr(ray_connect, "ANSWER_SECONDS", 2.0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(HwpError, match="does not answer as a Ray head within 2 s"):
            ray_connect.check_head(address)


@pytest.mark.slow
def test_jobs_side_by_side_give_the_results_of_jobs_in_turn(
    make_capture: CaptureMaker, tmp_path: Path, capsys
) -> None:
    from same_results import contents

    captures = [make_capture(name, frames=20, size=32).root for name in ("one", "two")]
    method = write_gray_method(tmp_path / "gray", seconds=0.1)
    base = ["evaluate", str(method), "--capture", *map(str, captures), "-o"]
    assert main([*base, str(tmp_path / "turn")]) == 0
    assert main([*base, str(tmp_path / "side"), "--jobs", "2"]) == 0
    assert "[2 of 2 ended" in capsys.readouterr().err
    assert contents(tmp_path / "side") == contents(tmp_path / "turn")
