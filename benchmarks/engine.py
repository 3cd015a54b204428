"""How time grows with jobs and workers: measured for 1 and 2 workers, modelled for more.

Run from the repository: `python -m benchmarks.engine [--seconds 3] [--jobs 2 4] [--no-ray]`.
A job reads 8 MiB, waits (`--seconds`, as for a fit on a device of its own), and writes 1 MiB; so
what is measured is the engine and not the processors that workers here would share. A Ray worker
is a node of one processor, started beforehand; inputs are sent. One job a worker goes before, so
that a node has its worker process and its inputs; of `--repeats` runs the fastest counts.

Model: T(J, W) = start + ceil(J / W) * (job + overhead). Job is what is waited; start and overhead
are the least-squares fit to the measurements with one worker. Two workers are then predicted and
held against what was measured.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from benchmarks.engine_work import INPUT_BYTES, Wait
from hwp_bench.run.engine import Engine, Folder, Job, LocalEngine
from hwp_bench.run.engine.job import OnProgress
from hwp_bench.run.engine.processes import ParallelEngine

#: Captures, variants and seeds of the modelled study.
STUDY = (11, 4, 3)
#: Workers of the modelled study.
WORKERS = (1, 2, 4, 8, 16, 32, 64, 132)


def make_jobs(folder: Path, source: Path, count: int, seconds: float) -> list[Job]:
    """Jobs of one kind, each into a folder of its own."""
    work = Wait(seconds)

    def make(number: int) -> Job:
        output = folder / str(number)

        def here(on_progress: OnProgress) -> None:
            work({"capture": source}, output, on_progress)

        inputs = {"capture": Folder(source)}
        return Job(f"job {number}", here, work, output, lambda: False, inputs)

    return [make(number) for number in range(count)]


def measure(
    engine: Engine, workers: int, source: Path, counts: Sequence[int], seconds: float, repeats: int
) -> list[float]:
    """Seconds from the first job's order to the last one's result, for each number of jobs."""

    def once(count: int, seconds: float) -> float:
        with tempfile.TemporaryDirectory() as name:
            jobs = make_jobs(Path(name), source, count, seconds)
            began = time.perf_counter()
            engine.run(jobs, lambda index: None)
            return time.perf_counter() - began

    with engine:
        once(workers, 1.0)
        return [min(once(count, seconds) for _ in range(repeats)) for count in counts]


def fit(counts: Sequence[int], times: Sequence[float], seconds: float) -> tuple[float, float]:
    """Start and overhead of one worker by least squares, neither below zero."""
    slope, start = np.polyfit(counts, times, 1)
    if start < 0.0:
        start, slope = 0.0, np.dot(counts, times) / np.dot(counts, counts)
    return float(start), max(float(slope) - seconds, 0.0)


def model(jobs: int, workers: int, job: float, start: float, overhead: float) -> float:
    """Seconds that the model gives."""
    return start + math.ceil(jobs / workers) * (job + overhead)


def report(name: str, counts: Sequence[int], times: dict[int, list[float]], job: float) -> None:
    """Print what was measured, the model's numbers, and the modelled study."""
    start, overhead = fit(counts, times[1], job)
    print(f"\n{name}: start {start:.2f} s, overhead {overhead:.2f} s a job")
    print(f"{'jobs':>5} {'workers':>8} {'measured s':>11} {'model s':>8} {'speed-up':>9}")
    for workers in sorted(times):
        for index, count in enumerate(counts):
            measured = times[workers][index]
            expected = model(count, workers, job, start, overhead)
            ratio = times[1][index] / measured
            print(f"{count:>5} {workers:>8} {measured:>11.2f} {expected:>8.2f} {ratio:>9.2f}")
    jobs = math.prod(STUDY)
    print(f"modelled: {jobs} jobs (captures x variants x seeds: {STUDY}) of 300 s")
    alone = model(jobs, 1, 300.0, start, overhead)
    for workers in WORKERS:
        seconds = model(jobs, workers, 300.0, start, overhead)
        print(f"{workers:>5} workers {seconds / 3600:>7.2f} h, speed-up {alone / seconds:6.2f}")


def measure_local(
    source: Path, counts: Sequence[int], seconds: float, repeats: int
) -> dict[int, list[float]]:
    engines: dict[int, Engine] = {1: LocalEngine(), 2: ParallelEngine(2)}
    return {
        workers: measure(engine, workers, source, counts, seconds, repeats)
        for workers, engine in engines.items()
    }


def measure_ray(
    source: Path, counts: Sequence[int], seconds: float, repeats: int
) -> dict[int, list[float]]:
    from ray.cluster_utils import Cluster

    from hwp_bench.run.engine.ray import RayEngine

    times: dict[int, list[float]] = {}
    with ExitStack() as stack:
        caches = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        cluster = Cluster()
        stack.callback(cluster.shutdown)
        for workers in (1, 2):
            os.environ["HWP_CACHE"] = str(caches / str(workers))
            cluster.add_node(num_cpus=1, object_store_memory=100 << 20, include_dashboard=False)
            engine = RayEngine(cluster.address, shared=False)
            times[workers] = measure(engine, workers, source, counts, seconds, repeats)
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=3.0, help="that a job waits")
    parser.add_argument("--jobs", type=int, nargs="+", default=[2, 4], help="numbers of jobs")
    parser.add_argument("--repeats", type=int, default=2, help="runs, of which the fastest counts")
    parser.add_argument("--no-ray", action="store_true", help="this machine's engines only")
    args = parser.parse_args()
    load = os.getloadavg()[0]
    print(
        f"{os.cpu_count()} processors, load {load:.1f} before the start; jobs of {args.seconds} s"
    )
    with tempfile.TemporaryDirectory() as name:
        source = Path(name)
        (source / "frames.bin").write_bytes(np.random.default_rng(0).bytes(INPUT_BYTES))
        local = measure_local(source, args.jobs, args.seconds, args.repeats)
        report("local (in turn; two at once)", args.jobs, local, args.seconds)
        if not args.no_ray:
            measured = measure_ray(source, args.jobs, args.seconds, args.repeats)
            report("Ray (one node; two nodes)", args.jobs, measured, args.seconds)
    print(f"\nload {os.getloadavg()[0]:.1f} at the end")


if __name__ == "__main__":
    main()
