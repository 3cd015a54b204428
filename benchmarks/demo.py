"""Seconds until `hwp-bench demo` has printed its tables, with and without machine code.

Run from the repository: `python -m benchmarks.demo`. The demo runs twice in processes of its own:
with an empty cache, then with the machine code of the first run but without its captures, as after
the installation of a new version. The reference is a process that imports torch and numba and
multiplies two matrices of 4,096 rows. The budget is five minutes of two cores, from an empty cache.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

#: Seconds until the tables, with nothing in the cache.
BUDGET = 300.0
_REFERENCE = "import torch, numba; x = torch.ones(4096, 4096); print((x @ x)[0, 0])"
_DEMO = ("-m", "hwp_bench.cli.main", "demo", "--out")


def spent(arguments: Sequence[str], cache: Path) -> tuple[float, float]:
    """Seconds by the clock until a Python program ends, and of the processor with its children."""
    environment = {**os.environ, "HWP_CACHE": str(cache), "HWP_KERNELS": ""}
    clock, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, *arguments], env=environment, check=True, stdout=subprocess.DEVNULL
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - clock, processor


def race() -> dict[str, tuple[float, float]]:
    """Seconds and processor seconds of the reference and of both demos."""
    with tempfile.TemporaryDirectory() as name:
        cache = Path(name) / "cache"
        found = {"reference": spent(["-c", _REFERENCE], cache)}
        found["cold"] = spent([*_DEMO, str(Path(name) / "first")], cache)
        shutil.rmtree(cache / "sim", ignore_errors=True)
        found["warm"] = spent([*_DEMO, str(Path(name) / "second")], cache)
    return found


def main() -> int:
    """Run the command."""
    argparse.ArgumentParser(description=__doc__.partition("\n")[0]).parse_args()
    found = race()
    reference = found["reference"][1]
    for name, (seconds, processor) in found.items():
        print(
            f"{name}: {seconds:.1f} s, processor {processor:.1f} s, {processor / reference:.1f} x"
        )
    print(f"budget from an empty cache: {BUDGET:g} s")
    return 0 if found["cold"][0] <= BUDGET else 1


if __name__ == "__main__":
    sys.exit(main())
