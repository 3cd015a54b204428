"""Seconds to compile the kernels of the toolkit, and to load them again.

Run from the repository: `python -m benchmarks.compile [--out FOLDER]`. Each measurement is a new
process with an empty cache, then one that finds its machine code. The reference is numba at work
on functions that are none of ours: `np.sort`, `np.argsort` and `np.median` of float64. Processor
time is what compiling costs whatever else runs; the budget is 20 s for all kernels.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hwp_bench.base.tables import Column, Table, print_table, to_markdown

#: Processor seconds that all kernels together may take.
BUDGET = 20.0
#: What a table calls the reference.
REFERENCE = "reference: sort, argsort, median"


def compile_all() -> dict[str, float]:
    """Processor seconds of every version that this process compiles, by kernel."""
    import numpy as np
    from numba.core import event

    class Listener(event.Listener):  # type: ignore[misc]
        def __init__(self) -> None:
            self.started: list[float] = []
            self.seconds: dict[str, float] = {}

        def on_start(self, event: Any) -> None:
            self.started.append(time.process_time())

        def on_end(self, event: Any) -> None:
            spent = time.process_time() - self.started.pop()
            if not self.started:  # what it calls is part of it
                function = event.data["dispatcher"].py_func
                name = f"{function.__module__}.{function.__qualname__}"
                self.seconds[name] = self.seconds.get(name, 0.0) + spent

    from hwp_bench.hands.raster import draw_faces, mix_corners
    from wildghand.gaussians import photometric_cpu
    from wildghand.splat import warmup

    listener = Listener()
    event.register("numba:compile", listener)
    warmup.warm_up(3)
    warmup.warm_up(4)
    photometric_cpu.warm_up()
    triangle = np.array([[0, 1, 2]])
    face, mix = draw_faces(np.zeros((3, 2)), np.ones(3), triangle, (2, 2))
    mix_corners(np.zeros((3, 3)), triangle, face[0] + 1, mix[0])
    return listener.seconds


def compile_reference() -> float:
    """Processor seconds of numba on NumPy's functions."""
    import numba
    import numpy as np

    @numba.njit
    def reference(x: Any) -> Any:
        return np.sort(x)[0] + np.argsort(x)[0] + np.median(x)

    start = time.process_time()
    reference(np.zeros(3))
    return time.process_time() - start


def child() -> dict[str, Any]:
    """What one process measures: the reference, each kernel, and all that making ready costs."""
    reference = compile_reference()
    start, clock = time.process_time(), time.perf_counter()
    kernels = compile_all()
    return {
        "reference": reference,
        "kernels": kernels,
        "processor": time.process_time() - start,
        "seconds": time.perf_counter() - clock,
    }


def cold_and_warm() -> tuple[dict[str, Any], dict[str, Any]]:
    """`child` in a process with an empty cache, and in one that finds it filled."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "HWP_CACHE": folder, "HWP_KERNELS": ""}
        command = [sys.executable, "-m", "benchmarks.compile", "--child"]
        first, second = (
            json.loads(
                subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True).stdout
            )
            for _ in range(2)
        )
    return first, second


def ratios(cold: Mapping[str, Any], warm: Mapping[str, Any]) -> dict[str, float]:
    """Compiling everything against the reference, and loading it; lower is better."""
    total = sum(cold["kernels"].values())
    loaded = float(warm["processor"]) / float(cold["processor"])
    return {
        "compile: all kernels / reference": total / cold["reference"],
        "compile: versions compiled again": float(len(warm["kernels"])),
        "compile: load / compile, with imports": loaded,
    }


def measure() -> Mapping[str, float]:
    """Return the ratios of `ratios`; takes some 20 s of one core."""
    return ratios(*cold_and_warm())


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, help="folder for table.md")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        print(json.dumps(child()))
        return 0
    cold, warm = cold_and_warm()
    total = sum(cold["kernels"].values())
    kernels = sorted(cold["kernels"].items(), key=lambda item: -item[1])
    rows = [*kernels, ("all kernels", total), (REFERENCE, cold["reference"])]
    columns = (Column("kernel"), Column("processor s", 2), Column("ratio", 2))
    table = Table(
        "Compiling the kernels",
        columns,
        tuple((name, spent, spent / cold["reference"]) for name, spent in rows),
        notes=(
            f"Budget: {BUDGET:g} s of one core for all. From an empty cache all took "
            f"{cold['processor']:.1f} s with imports, from a filled one {warm['processor']:.1f} s.",
        ),
    )
    print_table(table)
    print(json.dumps(ratios(cold, warm), indent=1))
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        (args.out / "table.md").write_text(to_markdown(table))
    return 0 if total <= BUDGET and not warm["kernels"] else 1


if __name__ == "__main__":
    sys.exit(main())
