"""Several jobs at once on this machine, each in a process of its own."""

from __future__ import annotations

import math
import os
import queue
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from hwp_bench.base.console import JobsView
from hwp_bench.base.errors import HwpError, UsageError
from hwp_bench.run.engine.job import RETRIES, Failures, Job, Needs, OnDone, OnStart, lost
from hwp_bench.run.engine.process import (
    VISIBLE_GPUS,
    LocalJob,
    WorkerLost,
    run_in_process,
    thread_environment,
)


class ParallelEngine:
    """Runs up to `at_once` jobs at once; a job whose process is killed is started again.

    Args:
        at_once: how many jobs run at once.
        view: shows the jobs; nothing if None.
        retries: times that a job is started again.
    """

    in_turn = False

    def __init__(
        self, at_once: int, view: JobsView | None = None, *, retries: int = RETRIES
    ) -> None:
        self._at_once = at_once
        self._view = view or JobsView(quiet=True)
        self._retries = retries

    def __enter__(self) -> ParallelEngine:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def run(self, jobs: Sequence[Job], on_done: OnDone, on_start: OnStart | None = None) -> None:
        """Run jobs; see `Engine.run`."""
        # Before anything runs: whoever asks for too many GPUs is told at once.
        visible = visible_gpus()
        needs = max((job.needs for job in jobs), key=lambda item: item.gpus, default=Needs())
        places: queue.SimpleQueue[tuple[int, dict[str, str]]] = queue.SimpleQueue()
        for place in enumerate(shares(self._at_once, needs, visible), start=1):
            places.put(place)
        ended: queue.SimpleQueue[tuple[int, BaseException | None]] = queue.SimpleQueue()
        stop = threading.Event()
        failures = Failures()

        def run_one(index: int) -> None:
            place, environment = places.get()
            try:
                if not stop.is_set():
                    self._run(index, jobs[index], place, environment, stop)
                ended.put((index, None))
            except BaseException as error:
                ended.put((index, error))
            finally:
                places.put((place, environment))

        with self._view as view, ThreadPoolExecutor(self._at_once) as pool:
            try:
                view.begin(len(jobs))
                for index in range(len(jobs)):
                    pool.submit(run_one, index)
                for _ in jobs:
                    index, error = _next(ended)
                    if error is not None and not isinstance(error, HwpError):
                        raise error
                    view.end(index, jobs[index].text, None if error is None else str(error))
                    if error is None:
                        on_done(index)
                    else:
                        failures.add(error)
            finally:
                stop.set()
        failures.raise_first(len(jobs))

    def _run(
        self, index: int, job: Job, place: int, gpus: dict[str, str], stop: threading.Event
    ) -> None:
        if job.finished():
            return
        local = LocalJob(
            job.work,
            {name: folder.path.absolute() for name, folder in job.inputs.items()},
            job.output.absolute(),
            {**thread_environment(job.needs), **gpus},
        )
        for attempt in range(self._retries + 1):
            self._view.start(index, job.text, f"place {place}")
            try:
                run_in_process(
                    local, lambda done, total: self._view.steps(index, done, total), stop.is_set
                )
                return
            except WorkerLost as error:
                if attempt == self._retries:
                    raise lost(job.text, self._retries, str(error)) from error


def _next(
    ended: queue.SimpleQueue[tuple[int, BaseException | None]],
) -> tuple[int, BaseException | None]:
    # A wait without end would not let Ctrl-C through on every system.
    while True:
        try:
            return ended.get(timeout=1.0)
        except queue.Empty:
            continue


def visible_gpus() -> list[str]:
    """Return the GPUs that this process may use, as `CUDA_VISIBLE_DEVICES` names them."""
    if VISIBLE_GPUS in os.environ:
        return [name.strip() for name in os.environ[VISIBLE_GPUS].split(",") if name.strip()]
    # The driver's own list; asking it costs no import of a GPU library.
    cards = Path("/proc/driver/nvidia/gpus")
    return [str(number) for number, _ in enumerate(cards.iterdir())] if cards.is_dir() else []


def shares(jobs: int, needs: Needs, gpus: list[str]) -> list[dict[str, str]]:
    """Divide GPUs among jobs that run at once.

    Args:
        jobs: how many run at once.
        needs: of each job; below one GPU several jobs share one, above one it is rounded up.
        gpus: the GPUs that there are.

    Returns:
        Environment variables for each place in the row of jobs; empty where no GPU is asked for,
        and the job then sees what this process sees.

    Raises:
        UsageError: there are too few.
    """
    if needs.gpus == 0:
        return [{} for _ in range(jobs)]
    each = 1 if needs.gpus <= 1 else math.ceil(needs.gpus)
    sharing = max(1, int(1 / needs.gpus + 1e-9))
    needed = math.ceil(jobs / sharing) * each
    if needed > len(gpus):
        raise UsageError(
            f"{jobs} jobs of {needs.gpus:g} GPUs at once need {needed} GPUs, and there are "
            f"{len(gpus)}",
            field="--jobs",
            remedy="Run fewer at once, or give each a fraction of a GPU with --job-gpus.",
        )
    first = [slot // sharing * each for slot in range(jobs)]
    return [{VISIBLE_GPUS: ",".join(gpus[start : start + each])} for start in first]
