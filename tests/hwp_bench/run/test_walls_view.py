"""Views from inside the walls. Oracle: what a script that runs as a method reports of itself."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from hwp_bench.base.packages import PACKAGES
from hwp_bench.run.sandbox.root import MASKED

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="process control is Linux's")


def test_nothing_of_the_machine_can_be_changed_through_proc_and_sys(attack) -> None:
    """Files are opened for writing and nothing is written; as root they all would open."""
    script = """
opened, known = [], []
for place in ("/proc", "/sys"):
    for folder, names, files in os.walk(place):
        if folder == "/proc":
            names[:] = [n for n in names if not n.isdigit() and n not in ("self", "thread-self")]
        for name in files:
            path = os.path.join(folder, name)
            if os.path.islink(path) or len(known) >= 20000:
                continue
            known.append(path)
            try:
                os.close(os.open(path, os.O_WRONLY | os.O_NONBLOCK))
                opened.append(path)
            except OSError:
                pass
masked = [open(f"/proc/{name}").read() for name in ("kallsyms", "timer_list") if
          os.path.exists(f"/proc/{name}")]
print(json.dumps({"opened": opened[:20], "known": len(known), "masked": "".join(masked)}))
"""
    _, said = attack(script)
    # /proc/kallsyms and such are the null device.
    assert [p for p in said["opened"] if p.removeprefix("/proc/") not in MASKED] == []
    assert said["known"] > 100
    assert said["masked"] == ""


def test_the_simulator_is_out_of_reach(attack) -> None:
    script = f"""
sys.path.insert(0, {str(PACKAGES)!r})
def works(name):
    try:
        __import__(name)
        return True
    except ImportError:
        return False
import hwp_bench
place = os.path.join(os.path.dirname(hwp_bench.__file__), "sim")
print(json.dumps({{
    "scenes": works("hwp_bench.sim.scene.reader"), "suites": works("hwp_bench.sim.produce.suites"),
    "hands": works("hwp_bench.hands.gestures"), "left": os.listdir(place),
}}))
"""
    _, said = attack(script)
    assert said == {"scenes": False, "suites": False, "hands": True, "left": []}


def test_earlier_runs_and_captures_next_to_a_method_stay_empty(attack, tmp_path: Path) -> None:
    runs = tmp_path / "method" / "runs" / "earlier"
    (runs / "captures" / "capture0" / "pictures").mkdir(parents=True)
    (runs / "results.json").write_text("{}")
    (runs / "captures/capture0/pictures/worst.png").write_text("a truth")
    capture = tmp_path / "method" / "data" / "mine"
    (capture / "truth").mkdir(parents=True)
    (capture / "capture.json").write_text("{}")
    (tmp_path / "method" / "data" / "weights.bin").write_text("its own")
    script = """
here = pathlib.Path(__file__).parent
found = sorted(str(path.relative_to(here)) for path in here.rglob("*") if path.is_file())
print(json.dumps({"found": found}))
"""
    _, said = attack(script)
    assert said["found"] == ["data/weights.bin", "method.toml", "run.py"]
