"""On how many threads the kernels of a fit's steps run: chosen by what measured steps gain.

What more threads bring depends on the machine, on the size of the fit and on what else runs. So the
first steps of a fit, and some from time to time, take turns on several numbers of threads, and the
steps after them run on the smallest that is nearly the fastest. Only kernels take part, whose
results are the same on every number: a fit has the same bits however its steps were timed.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch

from hwp_bench.base.numerics import count_is_chosen
from wildghand.splat.threads import at_most

#: Least number of steps that are timed together.
BLOCK = 8
#: Blocks of each number of threads in a measurement; the fastest counts, as other work is uneven.
TURNS = 2
#: Blocks between two measurements.
HELD = 32
#: Share by which more threads must be faster to be taken.
GAIN = 0.1


def candidates(most: int) -> tuple[int, ...]:
    """Numbers of threads that are compared: powers of two below `most`, and `most`."""
    return (*(1 << power for power in range((most - 1).bit_length())), most)


def fewest(seconds: Mapping[int, float]) -> int:
    """Return the smallest number of threads that is less than `GAIN` slower than the fastest.

    Args:
        seconds: of the same work, by number of threads.
    """
    best = min(seconds.values())
    return min(number for number, value in seconds.items() if value * (1.0 - GAIN) <= best)


class StepThreads:
    """The choice for one fit.

    Args:
        numbers: of threads, to choose from; one or none is not measured.
        shared: steps that share work which one of them does; a block has all of them.
    """

    def __init__(self, numbers: tuple[int, ...] = (), shared: int = 1) -> None:
        self._numbers = numbers
        self._block = -(-BLOCK // shared) * shared
        self._chosen = numbers[-1] if numbers else None
        # What the coming blocks run on; None stands for one on the chosen number.
        self._plan: list[int | None] = [None]
        self._best: dict[int, float] = {}
        self._steps, self._seconds = 0, 0.0

    @classmethod
    def of(cls, device: torch.device, shared: int = 1) -> StepThreads:
        """The choice for a fit on a device, from all that torch has.

        Nothing is chosen where a person or an engine has said how many (`OMP_NUM_THREADS`,
        `MKL_NUM_THREADS`), and on a GPU.
        """
        if device.type != "cpu" or count_is_chosen(os.environ):
            return cls()
        return cls(candidates(torch.get_num_threads()), shared)

    @property
    def number(self) -> int | None:
        """Threads of the next step; None: as many as torch has."""
        return self._plan[0] or self._chosen

    @contextmanager
    def step(self) -> Iterator[None]:
        """Run one step on the number of threads that is its turn."""
        if len(self._numbers) < 2:
            with at_most(self._chosen):
                yield
            return
        began = time.perf_counter()
        with at_most(self.number):
            yield
        self._seconds += time.perf_counter() - began
        self._steps += 1
        if self._steps == self._block:
            self._end_block()

    def _end_block(self) -> None:
        number, seconds = self._plan.pop(0), self._seconds
        self._steps, self._seconds = 0, 0.0
        if number is not None:
            self._best[number] = min(seconds, self._best.get(number, seconds))
        if self._plan:
            return
        if number is None:
            self._best = {}
            self._plan = [*self._numbers * TURNS]
        else:
            self._chosen = fewest(self._best)
            self._plan = [None] * HELD
