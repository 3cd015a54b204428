"""A method that is one script, run within the walls or without."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hostile import folder_of, hostile_method
from small_captures import CaptureMaker

from hwp_bench.capture.splits import contiguous_split
from hwp_bench.methods.contract import RunSettings
from hwp_bench.methods.manifest import read_manifest
from hwp_bench.methods.request import write_request
from hwp_bench.run.runner import DEFAULT_TIME_LIMIT, RunRecord, run_method
from hwp_bench.run.sandbox.confinement import Confinement


@pytest.fixture
def request_folder(make_capture: CaptureMaker, tmp_path: Path) -> Path:
    """The request of a small capture."""
    split = contiguous_split("tiny", 20)
    return write_request(tmp_path / "request", make_capture(frames=20), split, RunSettings({}))


@pytest.fixture
def attack(tmp_path: Path, namespaces: bool):
    """Return a function that runs a script as a method and returns its record and what it said."""

    def run(script: str, mode: str = "required", **limits) -> tuple[RunRecord, dict]:
        if mode == "required" and not namespaces:
            pytest.skip("no user namespaces on this machine")
        method = hostile_method(tmp_path / "method", script)
        time_limit = limits.pop("time_limit", DEFAULT_TIME_LIMIT)
        confinement = Confinement(mode, **limits)
        record = run_method(
            read_manifest(method),
            "tiny",
            folder_of(tmp_path / "request"),
            tmp_path / "output",
            time_limit=time_limit,
            confinement=confinement,
        )
        said = (tmp_path / "output" / "log.txt").read_text()
        return record, json.loads(said) if said.strip() else {}

    return run


@pytest.fixture(scope="module")
def namespaces(tmp_path_factory: pytest.TempPathFactory) -> bool:
    """Whether this machine allows them."""
    root = tmp_path_factory.mktemp("probe")
    method = read_manifest(hostile_method(root / "method", ""))
    record = run_method(method, "tiny", folder_of(root / "request"), root / "output")
    return record.isolation == "namespaces"
