"""The loops of two fits that take turns, so that other work on the machine slows both alike.

The plain baseline's own loop runs from its first step to its last; whenever it reports that it has
taken a block of steps, blocks of WildGHand's loop follow before it continues. Both are what a user
runs, with everything that they do between steps.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any
from unittest import mock

import numpy as np
import torch

from hwp_bench.methods.contract import Budget, TrainingCapture
from hwp_bench.methods.manifest import find_method
from wildghand.fitting.components import make_fit
from wildghand.fitting.method import ready_fit
from wildghand.gaussians.fit_loop import StepThreads
from wildghand.model.settings import read_settings
from wildghand.plain.loop import Watchers, run_fit
from wildghand.splat.threads import denormals_flushed

#: Least number of steps of a block.
BLOCK = 8
#: Wall-clock and processor seconds of a step; the processor's of all threads.
Spent = tuple[float, float]
#: Steps that the budget of a fit is made of; its loop is left long before.
BUDGET = 1_000_000


class _Enough(Exception):
    """Leaves a loop."""


class _Clock:
    """A report that takes the time of every step (see `hwp_bench.methods.contract.Report`)."""

    elapsed = 0.0

    def __init__(self, after_step: Callable[[int], None]) -> None:
        self.seconds: list[Spent] = []
        self._after_step = after_step
        self._last: Spent | None = None

    def __call__(self, step: int, avatar: object) -> None:
        wall, processor = _now()
        if self._last is not None:
            self.seconds.append((wall - self._last[0], processor - self._last[1]))
            self._after_step(len(self.seconds))
        self._last = _now()

    def progress(self, done: int, total: int) -> None:
        pass


def _now() -> Spent:
    return time.perf_counter(), time.process_time()


class WildGHandLoop:
    """The loop of WildGHand's fit, taken a block of steps at a time.

    Args:
        training: what it may see.
        settings: of the method.
        threads: chooses the number of threads; None: as many as torch has.
    """

    def __init__(
        self,
        training: TrainingCapture,
        settings: Mapping[str, Any],
        threads: StepThreads | None = None,
    ) -> None:
        chosen = read_settings({"device": "cpu", **settings})
        self._fit = make_fit(training, chosen, 0, ready_fit("cpu"))
        self._watchers = Watchers()
        self._threads = threads or StepThreads()
        self._taken = 0
        # Steps may share work, which one of them does: a block has each of them equally often.
        shared: int = chosen.schedule.texture_every
        self._block = -(-BLOCK // shared) * shared

    def block(self, blocks: int = 1, *, flush: bool = True) -> list[Spent]:
        """Take blocks of steps; returns the seconds of each step.

        Args:
            blocks: how many.
            flush: treat denormals as a fit does, or compute with them.
        """
        steps = blocks * self._block

        def stop(taken: int) -> None:
            if taken == steps:
                raise _Enough

        clock = _Clock(stop)
        budget = Budget(steps=BUDGET)
        denormals = denormals_flushed() if flush else contextlib.nullcontext()
        with denormals, contextlib.suppress(_Enough):
            run_fit(
                self._fit,
                budget,
                clock,
                start=self._taken,
                watchers=self._watchers,
                threads=self._threads,
            )
        self._taken += steps
        return clock.seconds


def run_plain(
    training: TrainingCapture,
    settings: Mapping[str, Any],
    blocks: int,
    after_block: Callable[[int, list[Spent]], None],
) -> None:
    """Run the loop of the plain baseline.

    Args:
        training: what it may see.
        settings: of the method.
        blocks: how many blocks of steps to take.
        after_block: called after each block with its number and the seconds of its steps.
    """
    sys.path.insert(0, str(find_method("plain")))
    from plain_fit.method import PlainMethod

    clock: _Clock

    def after_step(taken: int) -> None:
        if taken % BLOCK == 0:
            after_block(taken // BLOCK - 1, clock.seconds[-BLOCK:])
            if taken == blocks * BLOCK:
                raise _Enough

    clock = _Clock(after_step)
    # As by a person who says how many threads there are: the loop chooses none.
    said = mock.patch.dict(os.environ, {"OMP_NUM_THREADS": str(torch.get_num_threads())})
    with said, contextlib.suppress(_Enough):
        PlainMethod({"device": "cpu", **settings}).fit(training, Budget(steps=BUDGET), clock)


def race(
    training: TrainingCapture,
    plain: Mapping[str, Any],
    others: Mapping[str, WildGHandLoop],
    threads: tuple[int, ...],
    rounds: int,
) -> dict[tuple[str, int], Spent]:
    """Let fits take turns, on every number of threads.

    Args:
        training: what they may see.
        plain: settings of the plain baseline.
        others: fits by name.
        threads: numbers of threads.
        rounds: turns of each fit that count; one more goes before.

    Returns:
        Mean seconds of a step in a block, of the `typical` block, by name (the baseline is
        `plain`) and number of threads.
    """
    names = ("plain", *others)
    found: dict[tuple[str, int], list[Spent]] = {(name, n): [] for name in names for n in threads}
    torch.set_num_threads(threads[0])

    def after_block(number: int, seconds: list[Spent]) -> None:
        turn, place = divmod(number, len(threads))
        taken = {"plain": seconds}
        taken |= {name: loop.block() for name, loop in others.items()}
        if turn > 0:
            for name, values in taken.items():
                found[name, threads[place]].append(mean_of(values))
        torch.set_num_threads(threads[(place + 1) % len(threads)])

    run_plain(training, plain, (rounds + 1) * len(threads), after_block)
    return {key: typical(blocks) for key, blocks in found.items()}


def mean_of(steps: Sequence[Spent]) -> Spent:
    """The mean step of a block."""
    wall, processor = np.mean(steps, axis=0).tolist()
    return wall, processor


def typical(blocks: Sequence[Spent]) -> Spent:
    """The wall-clock seconds of the fastest block, which other work has slowed least, and the
    median of the processor seconds."""
    walls, processors = zip(*blocks, strict=True)
    return min(walls), float(np.median(processors))


@contextlib.contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Keep processors busy with other processes while this holds.

    Args:
        count: how many.
    """
    # A loop that ends with whoever started it.
    loop = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: sum(range(100_000))"
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            process = stack.enter_context(subprocess.Popen([sys.executable, "-S", "-c", loop]))
            stack.callback(process.kill)
        yield


def crowded(
    loops: Mapping[str, WildGHandLoop], threads: Mapping[str, int], rounds: int, busy: int
) -> dict[str, Spent]:
    """Let fits take turns beside busy processes.

    Args:
        loops: fits by name.
        threads: of torch, by name.
        rounds: turns of each that count; one more goes before.
        busy: number of busy processes.

    Returns:
        Medians of the mean seconds of a step in a block, by name.
    """
    found: dict[str, list[Spent]] = {name: [] for name in loops}
    with busy_processes(busy):
        for turn in range(rounds + 1):
            for name, loop in loops.items():
                torch.set_num_threads(threads[name])
                seconds = mean_of(loop.block())
                if turn > 0:
                    found[name].append(seconds)
    medians = {name: np.median(blocks, axis=0).tolist() for name, blocks in found.items()}
    return {name: (wall, processor) for name, (wall, processor) in medians.items()}
