"""What a step of a fit costs on a GPU, next to the same step on the CPU.

Run from the repository, on a machine with a CUDA GPU and the extra `cuda`: `python -m
benchmarks.gpu [CAPTURE] [--rows NAME ...] [--threads N] [--rounds N] [--json]`. Without a capture a
small one of 176 px is rendered. Both devices take blocks of steps of one fit in turns, in one
process; the median block counts. A step is queued on a GPU, so each block waits for its end. The
GPU's own seconds are those of its kernels, by the profiler: what is left of a step is the host,
which starts them one by one.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile

from benchmarks.small_capture import opened_request, small_capture
from hwp_bench.base.tables import Column, Table, print_table
from hwp_bench.methods.contract import TrainingCapture
from hwp_bench.methods.manifest import find_method, read_manifest
from wildghand.fitting.components import make_fit
from wildghand.fitting.method import ready_fit
from wildghand.model.settings import read_settings
from wildghand.splat.threads import denormals_flushed

#: Steps of a block: as many share the texture branch of the network.
BLOCK = 8
#: Of a fit's budget, used up: every term of the loss acts.
_FRACTION = 0.5


@dataclass(frozen=True)
class Row:
    """A fit that is measured."""

    #: Preset of WildGHand.
    preset: str
    #: Settings in place of the preset's.
    changes: Mapping[str, Any]
    #: Steps of a block on the CPU; those of the published sizes take seconds each.
    cpu_steps: int = BLOCK

    def settings(self, device: str) -> dict[str, Any]:
        """What a fit on a device reads."""
        preset = read_manifest(find_method("wildghand")).presets[self.preset]
        return {**preset, **self.changes, "device": device}


ROWS = {
    "mini": Row("mini", {}),
    "default": Row("default", {}),
    "default, 4 frames": Row("default", {"schedule.batch": 4}),
    "49,281 Gaussians": Row("default", {"gaussians": 49281}),
    "paper": Row("paper", {}, cpu_steps=1),
    "paper, half precision": Row("paper", {"mixed_precision": True}, cpu_steps=1),
}


@dataclass(frozen=True)
class Cost:
    """Of a step, milliseconds but for the last."""

    cpu: float
    gpu: float
    #: Of the kernels alone.
    kernels: float
    #: Kernels that are started.
    started: float
    #: Most memory of the GPU that is in use, MiB.
    memory: float


class Loop:
    """A fit on a device, a block of steps at a time."""

    def __init__(self, training: TrainingCapture, settings: Mapping[str, Any]) -> None:
        chosen = read_settings(dict(settings))
        self.device = ready_fit(chosen.device)
        self._fit = make_fit(training, chosen, 0, self.device)
        self._order = self._fit.batches()

    def block(self, steps: int = BLOCK) -> float:
        """Take steps; returns the seconds of one."""
        self._wait()
        began = time.perf_counter()
        with denormals_flushed():
            for _ in range(steps):
                loss = self._fit.step(next(self._order), _FRACTION)
        self._wait()
        seconds = (time.perf_counter() - began) / steps
        if not np.isfinite(float(loss)):
            raise SystemExit(f"the loss on {self.device} is not finite")
        return seconds

    def kernels(self) -> tuple[float, float]:
        """Seconds of the kernels of a step, and how many are started."""
        with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as found:
            self.block()
        events = [e for e in found.events() if e.device_type == torch.autograd.DeviceType.CUDA]
        return sum(e.device_time for e in events) / 1e6 / BLOCK, len(events) / BLOCK

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize()


def measure(training: TrainingCapture, row: Row, rounds: int) -> Cost:
    """Steps of one fit on both devices, in turns.

    Args:
        training: what the fit may see.
        row: of which settings.
        rounds: blocks on each device that count; one more goes before.
    """
    torch.cuda.reset_peak_memory_stats()
    loops = {device: Loop(training, row.settings(device)) for device in ("cpu", "cuda")}
    found: dict[str, list[float]] = {device: [] for device in loops}
    for turn in range(-1, rounds):
        for device, loop in loops.items():
            seconds = loop.block(row.cpu_steps if device == "cpu" else BLOCK)
            if turn >= 0:
                found[device].append(seconds)
    cpu, gpu = (1e3 * float(np.median(found[device])) for device in ("cpu", "cuda"))
    memory = torch.cuda.max_memory_allocated() / 2**20
    busy, started = loops["cuda"].kernels()
    return Cost(cpu, gpu, 1e3 * busy, started, memory)


def table(costs: Mapping[str, Cost]) -> Table:
    """A line for each fit."""
    columns = [
        Column("fit"),
        Column("CPU [ms]", digits=1),
        Column("GPU [ms]", digits=1),
        Column("CPU / GPU", digits=1),
        Column("kernels alone [ms]", digits=1),
        Column("kernels", digits=0),
        Column("memory [MiB]", digits=0),
    ]
    lines = [
        (name, c.cpu, c.gpu, c.cpu / c.gpu, c.kernels, c.started, c.memory)
        for name, c in costs.items()
    ]
    return Table("A step of a fit", tuple(columns), tuple(lines))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", nargs="?", help="capture folder (a small one of 176 px)")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS), help="fits")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="of the CPU")
    parser.add_argument("--rounds", type=int, default=5, help="blocks on each device (5)")
    parser.add_argument("--json", action="store_true", help="print numbers for programs")
    args = parser.parse_args(arguments)
    if not torch.cuda.is_available():
        raise SystemExit("benchmarks.gpu needs a CUDA GPU")
    torch.set_num_threads(args.threads)
    costs = {}
    with opened_request(small_capture(args.capture)) as training:
        for name in args.rows:
            costs[name] = measure(training, ROWS[name], args.rounds)
            print(f"{name}: {costs[name]}", file=sys.stderr, flush=True)
    if args.json:
        print(json.dumps({name: asdict(cost) for name, cost in costs.items()}, indent=2))
    else:
        print(f"{torch.cuda.get_device_name()}, {args.threads} threads of the CPU")
        print_table(table(costs))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
