"""Seconds of `hwp-bench report` for many runs, next to plots that matplotlib draws.

Run from the repository: `python -m benchmarks.report [--methods 6] [--seeds 4] [--profile]`. The
runs are made of random scores and pictures: the eleven captures of the paper, 30 test frames each.
The reference is one line plot of 30 points, drawn by matplotlib and written as SVG, times the
captures. Both take turns in one process, so that other work on the machine slows them alike. The
budget for 24 runs is 10 s.
"""

from __future__ import annotations

import argparse
import cProfile
import io
import json
import pstats
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.images import write_image
from hwp_bench.report.page import write_report
from hwp_bench.report.sources import read_sources
from hwp_bench.results import (
    CaptureResult,
    CurvePoint,
    FrameResult,
    MethodId,
    Results,
    TrainingData,
    write_results,
)
from hwp_bench.taxonomy import PERTURBATIONS

#: Seconds that a report of 24 runs may take.
BUDGET = 10.0
#: Captures of each run, and test frames of each capture.
CAPTURES, FRAMES = 11, 30
#: Checkpoints of each fit.
CHECKPOINTS = 12
#: Size of a comparison sheet, px.
SHEET = (400, 1056)


def make_runs(folder: Path, methods: int, seeds: int) -> list[Path]:
    """Write results with pictures and temporal weights; returns their folders."""
    rng = np.random.default_rng(0)
    runs = []
    for method in range(methods):
        for seed in range(seeds):
            run = folder / f"method{method}-{seed}"
            captures = [make_capture(rng, number, method) for number in range(CAPTURES)]
            for capture in captures:
                place = run / "captures" / capture.id
                smooth = np.cumsum(rng.normal(0, 3, (*SHEET, 3)), axis=1) + 128
                write_image(place / "pictures" / "comparison.png", smooth.clip(0, 255).astype("u1"))
                weights = {"frames": list(range(100)), "weights": rng.random(100).tolist()}
                (place / "diagnostics").mkdir(parents=True)
                (place / "diagnostics" / "temporal.json").write_text(json.dumps(weights))
            write_results(run / "results.json", make_results(f"method{method}", seed, captures))
            runs.append(run)
    return runs


def make_capture(rng: np.random.Generator, number: int, method: int) -> CaptureResult:
    """Random scores of one capture."""
    base = 20.0 + 0.3 * method

    def scores() -> dict[str, float]:
        return {
            "psnr": base + rng.normal(),
            "ssim": rng.random(),
            "oriented_distance": rng.random(),
        }

    times = np.geomspace(1.0, 60.0, CHECKPOINTS)
    return CaptureResult(
        id=f"capture{number}",
        digest=f"d{number}",
        hands="both" if number % 2 else "right",
        perturbations=[list(PERTURBATIONS)[number % len(PERTURBATIONS)]],
        split_digest="s",
        exact_masks=True,
        key="k",
        frames=[FrameResult(100 + frame, scores(), None) for frame in range(FRAMES)],
        failure=None,
        predictions_digest="p",
        fit_seconds=60.0,
        render_seconds=1.0,
        score_seconds=0.1,
        wall_seconds=62.0,
        steps=1000,
        peak_memory=10**9,
        device="cpu",
        curve=[
            CurvePoint(int(10 * t), float(t), 10**9, {"psnr": base - 5.0 / t + rng.normal(0, 0.1)})
            for t in times
        ],
    )


def make_results(name: str, seed: int, captures: list[CaptureResult]) -> Results:
    """One run of a method."""
    return Results(
        method=MethodId(name, name.title(), "m", "default", {"steps": 1000}, TrainingData()),
        suite="full",
        seed=seed,
        budget={"seconds": None, "steps": None},
        frames="perturbed",
        protocols={},
        captures=captures,
        environment={},
        started="2025-01-01T00:00:00+00:00",
        toolkit="0",
    )


def draw_plots(folder: Path) -> None:
    """The reference: as many line plots as there are captures, by matplotlib alone."""
    from matplotlib.figure import Figure

    rng = np.random.default_rng(0)
    for _ in range(CAPTURES):
        figure = Figure()
        figure.add_subplot().plot(rng.random(FRAMES))
        figure.savefig(io.BytesIO(), format="svg")


def draw_report(folder: Path) -> None:
    """The report of all runs in a folder, as the command makes it."""
    runs = sorted(path for path in folder.iterdir() if (path / "results.json").is_file())
    write_report(folder / "report", read_sources(runs))


def spent(work: Callable[[Path], None], folder: Path) -> tuple[float, float]:
    """Seconds by the clock and of the processor."""
    clock, processor = time.perf_counter(), time.process_time()
    work(folder)
    return time.perf_counter() - clock, time.process_time() - processor


def turns(methods: int, seeds: int, rounds: int) -> dict[str, Any]:
    """Median seconds and processor seconds of the report and the reference, taken in turns."""
    with tempfile.TemporaryDirectory() as name:
        make_runs(Path(name), methods, seeds)
        draw_plots(Path(name))  # loads matplotlib
        rows = [
            (*spent(draw_plots, Path(name)), *spent(draw_report, Path(name))) for _ in range(rounds)
        ]
    medians = np.median(rows, axis=0).tolist()
    names = ("plots", "plots, processor", "report", "report, processor")
    return dict(zip(names, medians, strict=True))


def measure(rounds: int = 2) -> Mapping[str, float]:
    """Return the processor time of a report of 24 runs over that of the reference."""
    found = turns(6, 4, rounds)
    return {"24 runs / plots": found["report, processor"] / found["plots, processor"]}


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--methods", type=int, default=6)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--profile", action="store_true", help="print where the time goes")
    args = parser.parse_args()
    if args.profile:
        with tempfile.TemporaryDirectory() as name:
            make_runs(Path(name), args.methods, args.seeds)
            draw_plots(Path(name))
            with cProfile.Profile() as profile:
                draw_report(Path(name))
        pstats.Stats(profile).sort_stats("cumulative").print_stats(45)
        return 0
    found = turns(args.methods, args.seeds, args.rounds)
    runs = args.methods * args.seeds
    print(f"report of {runs} runs: {found['report']:.1f} s ({found['report, processor']:.1f} s of ")
    print(f"the processor), {CAPTURES} plots: {found['plots']:.2f} s; ratio of processor time ")
    print(f"{found['report, processor'] / found['plots, processor']:.1f}; budget {BUDGET:g} s")
    return 0 if found["report"] <= BUDGET else 1


if __name__ == "__main__":
    sys.exit(main())
