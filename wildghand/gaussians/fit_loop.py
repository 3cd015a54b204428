"""Parts of the loop of every fit: device, budget, batches, threads."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from hwp_bench.base.errors import MissingDependency
from hwp_bench.base.numerics import count_is_chosen
from hwp_bench.methods.contract import Budget, Report
from wildghand.gaussians.adam import ClippedAdam
from wildghand.gaussians.losses import LANES, photometric_loss
from wildghand.gaussians.rig import warm_up_posing
from wildghand.splat.numba_backend import warm_up
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
    """The smallest number of threads that is less than `GAIN` slower than the fastest."""
    best = min(seconds.values())
    return min(number for number, value in seconds.items() if value * (1.0 - GAIN) <= best)


class StepThreads:
    """The choice of a number of threads for one fit, among `numbers`.

    `shared` steps share work which one of them does; a block has all of them.
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


#: The loss of a step: a number, or a scalar on a device, which nobody has waited for yet.
Loss = float | torch.Tensor


def _warm_up() -> None:
    """Make the kernels of a loss and of a step ready: compiled once on a machine, loaded later."""
    with torch.enable_grad():
        row = torch.zeros(1, 1, LANES, 1, requires_grad=True)
        loss = photometric_loss(row, row.detach(), torch.zeros(1, 1, LANES), 0.5)
        loss.backward()
    ClippedAdam([{"params": [row], "lr": 0.0}], 1.0).take_step(loss)


def choose_device(name: str) -> torch.device:
    """Resolve `auto`, `cpu` or `cuda`; `auto` is CUDA where both a GPU and gsplat are available.

    Raises:
        MissingDependency: CUDA was asked for and is not available.
    """
    if name == "cpu":
        return torch.device("cpu")
    ready = torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None
    if name == "cuda" and not ready:
        raise MissingDependency(
            "a CUDA GPU and the package gsplat are not both available",
            field="device",
            remedy="Use device = auto or cpu, or install the extra `cuda`.",
        )
    return torch.device("cuda" if ready else "cpu")


def ready_device(name: str) -> torch.device:
    """Choose the device (see `choose_device`), and compile for it what a fit needs.

    Compiling takes some ten seconds, once on a machine. It is not a part of a fit, so this goes
    before its clock.
    """
    device = choose_device(name)
    if device.type == "cpu":
        warm_up()
        warm_up_posing()
        _warm_up()
    return device


@contextlib.contextmanager
def repeatable(device: torch.device) -> Iterator[None]:
    """Make gradients on the CPU the same bit for bit every time, on several threads too.

    Where a tensor is read through an index, PyTorch adds up the gradient of large tensors with
    atomic additions, in whatever order its threads come. On CUDA this does nothing, and nothing
    where it holds already: setting it costs as much as some ten operations.
    """
    filling: Any = torch.utils.deterministic
    before = torch.are_deterministic_algorithms_enabled(), filling.fill_uninitialized_memory
    if device.type != "cpu" or before == (True, False):
        yield
        return
    mode = torch.get_deterministic_debug_mode()
    # `use_deterministic_algorithms` also tells torch's compiler, which takes two seconds to import.
    torch.set_deterministic_debug_mode("error")
    # Filling new memory with NaN costs time and changes no result.
    filling.fill_uninitialized_memory = False
    try:
        yield
    finally:
        torch.set_deterministic_debug_mode(mode)
        filling.fill_uninitialized_memory = before[1]


def spent(step: int, steps: int, budget: Budget, report: Report) -> float:
    """Share of the budget that is used up: of the steps or of the seconds, whichever is more."""
    if budget.seconds is None:
        return step / steps
    if budget.seconds <= 0.0:
        return 1.0
    return max(step / steps, report.elapsed / budget.seconds)


def batches(count: int, batch: int, seed: int) -> Iterator[torch.Tensor]:
    """Batches of row numbers, (batch,) int64, without end: every row once before any again."""
    random = np.random.default_rng(seed)
    queue = np.empty(0, dtype=np.int64)
    while True:
        while len(queue) < batch:
            queue = np.concatenate((queue, random.permutation(count)))
        yield torch.from_numpy(queue[:batch])
        queue = queue[batch:]
