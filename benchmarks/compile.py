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

import numba
import numpy as np
from numba.core import event

from hwp_bench.base.tables import Column, Table, print_table, to_markdown

#: Processor seconds that all kernels together may take.
BUDGET = 20.0
#: What a table calls the reference.
REFERENCE = "reference: sort, argsort, median"


class Listener(event.Listener):
    """Processor seconds of every version that this process compiles, by kernel."""

    def __init__(self) -> None:
        self.started: list[float] = []
        self.seconds: dict[str, float] = {}

    def on_start(self, event: Any) -> None:
        """Start the clock."""
        self.started.append(time.process_time())

    def on_end(self, event: Any) -> None:
        """Add the seconds to those of the kernel."""
        spent = time.process_time() - self.started.pop()
        if not self.started:  # what it calls is part of it
            function = event.data["dispatcher"].py_func
            name = f"{function.__module__}.{function.__qualname__}"
            self.seconds[name] = self.seconds.get(name, 0.0) + spent


def ready_to_fit() -> None:
    """Make ready what a fit and its rasterizer call."""
    from wildghand.fitting.method import ready_fit

    ready_fit("cpu")


def use_the_rest() -> None:
    """Call what a fit does not need: other numbers of channels, meshes, a simulated frame."""
    from benchmarks.simulation import KINDS, SPREAD, frames_of
    from hwp_bench.hands.raster import draw_faces, mix_corners
    from hwp_bench.sim.render.frame import render_frame
    from hwp_bench.sim.scene_files import load_scene
    from wildghand.splat import numba_backend as warmup

    warmup.warm_up(4)
    triangle = np.array([[0, 1, 2]])
    face, mix = draw_faces(np.zeros((3, 2)), np.ones(3), triangle, (2, 2))
    mix_corners(np.zeros((3, 3)), triangle, face[0] + 1, mix[0])
    scene = load_scene("capture0")
    for kind in KINDS[:2]:
        render_frame(scene, frames_of(kind, scene, 64, 1)[0], SPREAD, 64)


def compile_reference() -> float:
    """Processor seconds of numba on NumPy's functions."""

    @numba.njit
    def reference(x: Any) -> Any:
        return np.sort(x)[0] + np.argsort(x)[0] + np.median(x)

    start = time.process_time()
    reference(np.zeros(3))
    return time.process_time() - start


def child() -> dict[str, Any]:
    """Measure in this process: the reference, each kernel, and making a fit ready, with imports."""
    reference = compile_reference()
    listener = Listener()
    event.register("numba:compile", listener)
    start = time.process_time()
    ready_to_fit()
    ready, fit = time.process_time() - start, sum(listener.seconds.values())
    use_the_rest()
    return {"reference": reference, "kernels": listener.seconds, "fit": fit, "ready": ready}


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
    """Compiling against the reference, and loading against compiling; lower is better."""
    return {
        "all kernels / reference": sum(cold["kernels"].values()) / cold["reference"],
        "ready to fit, loaded / compiled": warm["ready"] / cold["ready"],
        "share of kernels compiled again": len(warm["kernels"]) / len(cold["kernels"]),
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
            f"Budget: {BUDGET:g} s of one core for all; those that a fit needs took "
            f"{cold['fit']:.1f} s. With imports a fit was ready after {cold['ready']:.1f} s from "
            f"an empty cache, after {warm['ready']:.1f} s from a filled one.",
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
