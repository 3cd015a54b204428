"""Equal seconds: no baseline spends its own on an import that WildGHand has left out."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from painted import TrainingMaker

BASELINES = Path(__file__).resolve().parents[2] / "baselines"
#: Fits with every baseline in one process, and prints what each has imported meanwhile.
PROGRAM = """
import json, sys
from pathlib import Path
from painted import SilentReport
from hwp_bench.methods.contract import Budget
from hwp_bench.methods.manifest import read_manifest
from hwp_bench.methods.request import open_request
from hwp_bench.run.worker import load_entry

training = open_request(Path(sys.argv[1]))
found = {}
for folder in map(Path, sys.argv[2:]):
    settings = {**read_manifest(folder).presets["smoke"], "device": "cpu", "gaussians": 400}
    method = load_entry(folder, read_manifest(folder).entry.python)(settings, 0)
    before = set(sys.modules)
    method.fit(training, Budget(steps=1), SilentReport())
    found[folder.name] = sorted({name.split(".")[1] for name in set(sys.modules) - before
                                 if name.startswith("torch.")})
print(json.dumps(found))
"""


@pytest.mark.slow
@pytest.mark.usefixtures("machine_code")
def test_no_baseline_imports_parts_of_torch_within_its_fit(
    make_training: TrainingMaker,
) -> None:
    """Torch's compiler takes one to two seconds, of a budget of 16."""
    request = make_training().root
    methods = sorted(str(path.parent) for path in BASELINES.glob("*/method.toml"))
    assert len(methods) >= 11
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(request), *methods],
        capture_output=True, text=True, check=False, cwd=Path(__file__).resolve().parents[1],
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {Path(method).name: [] for method in methods}
