"""A script that is run as a method inside the walls, for tests of what it can see and do there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from small_methods import SCRIPT, write_manifest

from hwp_bench.methods.manifest import read_manifest
from hwp_bench.run.runner import run_method
from hwp_bench.run.sandbox.confinement import Confinement


def run_walled(folder: Path, script: str, **confinement: Any) -> Any:
    """Run a script inside the walls and return what it prints last, read as JSON.

    The test is skipped where the machine has no user namespaces.
    """
    method = folder / "method"
    method.mkdir(exist_ok=True)
    (folder / "request").mkdir()
    (method / "run.py").write_text(f"import json, os, sys\n{script}")
    write_manifest(method, "looker", SCRIPT)
    record = run_method(
        read_manifest(method),
        "tiny",
        folder / "request",
        folder / "output",
        confinement=Confinement("auto", **confinement),
    )
    if record.isolation != "namespaces":
        pytest.skip("no user namespaces on this machine")
    return json.loads((folder / "output" / "log.txt").read_text().splitlines()[-1])
