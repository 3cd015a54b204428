"""What one step of a fit costs, component by component, next to one of the plain baseline.

Run from the repository: `python -m benchmarks.step [CAPTURE] [--gaussians 5000] [--threads 1 2]
[--batch 1 4] [--set NAME=VALUE] [--flame FILE.svg] [--json] [--busy]`. Without a capture a small
one of 176 px is rendered. Both methods have as many Gaussians and draw the same frames of one
capture; their loops take turns in one process, and whole steps (means of blocks) are compared: on
one thread the median of the processor's seconds, which other work on the machine hardly changes; on
several the clock on the wall, in the fastest block. The components are the profiler's shares of
those times, on the first number of threads and with the first size of batch.

`--busy` measures something else: steps of one frame beside one busy process for each core. A fit
that chooses its threads as a user's does, one on two threads and one on a single thread take turns,
and medians of their blocks are compared. A step that needs p times the processor seconds of one on
a single thread takes p times as long as that where both get as much of the processor, so the row is
that of processor seconds; the clock on the wall stands next to it.
"""

from __future__ import annotations

import argparse
import io
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks.small_capture import opened_request, small_capture
from benchmarks.step_loops import BLOCK, Spent, WildGHandLoop, crowded, race, run_plain
from benchmarks.step_picture import draw_flames
from benchmarks.step_shares import Shares, by_component, shares_of
from benchmarks.step_spans import marked, profiled
from hwp_bench.base.files import atomic_write
from hwp_bench.base.tables import Column, Table, print_table
from hwp_bench.cli.options import overrides
from hwp_bench.methods.contract import TrainingCapture
from wildghand.gaussians.fit_loop import StepThreads, candidates

#: Gaussians of a step that is measured.
GAUSSIANS = 5_000
#: Blocks of steps of each fit that count.
ROUNDS = 8
#: Blocks that a loop has behind it when it is profiled.
WARM = 3


@dataclass(frozen=True)
class Workload:
    """What is fitted by both."""

    training: TrainingCapture
    gaussians: int = GAUSSIANS
    #: Further settings of WildGHand.
    settings: Mapping[str, Any] | None = None

    def plain(self, batch: int) -> dict[str, Any]:
        """Settings of the plain baseline."""
        return {"gaussians": self.gaussians, "batch": batch}

    def loop(self, batch: int, threads: StepThreads | None = None) -> WildGHandLoop:
        """A new fit of WildGHand, on as many threads as torch has unless something chooses."""
        chosen: dict[str, Any] = {"gaussians": self.gaussians, "schedule.batch": batch}
        return WildGHandLoop(self.training, chosen | dict(self.settings or {}), threads)


@dataclass(frozen=True)
class Times:
    """Milliseconds of a step on a number of threads."""

    wall: float
    processor: float

    def over(self, other: Times, threads: int) -> float:
        """This as a multiple of another. On one thread the processor's time counts, which is the
        same on a busy machine; on several the clock on the wall does."""
        if threads == 1:
            return self.processor / other.processor
        return self.wall / other.wall


#: By method, frames in a step and threads.
Steps = dict[tuple[str, int, int], Times]


def whole_steps(
    workload: Workload, batches: Sequence[int], threads: Sequence[int], rounds: int
) -> tuple[Steps, dict[str, float]]:
    """Times of whole steps, and the ratios that they make.

    A ratio is taken within one race, whose fits take turns.
    """
    steps: Steps = {}
    ratios: dict[str, float] = {}
    first = batches[0]
    for batch in batches:
        loops = {"wildghand": workload.loop(batch)}
        if batch != first:
            loops["single"] = workload.loop(first)
        found = race(workload.training, workload.plain(batch), loops, tuple(threads), rounds)
        medians = {
            key: Times(1e3 * wall, 1e3 * processor) for key, (wall, processor) in found.items()
        }
        for count in threads:
            where = f"{_count(batch, 'frame')}, {_count(count, 'thread')}"
            step, plain = medians["wildghand", count], medians["plain", count]
            steps["wildghand", batch, count], steps["plain", batch, count] = step, plain
            ratios[f"wildghand / plain, {where}"] = step.over(plain, count)
            if batch != first:
                single = step.over(medians["single", count], count)
                ratios[f"wildghand / {_count(first, 'frame')}, {where}"] = single
            if count != threads[0]:
                for method in ("wildghand", "plain"):
                    fewer = medians[method, threads[0]]
                    name = f"{method} / {_count(threads[0], 'thread')}, {where}"
                    ratios[name] = medians[method, count].over(fewer, count)
    return steps, ratios


def beside_busy(workload: Workload, rounds: int) -> dict[str, float]:
    """Ratios of steps beside one busy process for each core, to a step on one thread there.

    Args:
        workload: what is fitted, one frame in a step.
        rounds: turns of each fit.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    most = max(2, cores or 1)
    choice = StepThreads(candidates(most), shared=BLOCK)
    loops = {"one": workload.loop(1), "two": workload.loop(1), "chosen": workload.loop(1, choice)}
    found = crowded(loops, {"one": 1, "two": 2, "chosen": most}, rounds, cores or 1)
    one = Times(*found.pop("one"))
    ratios = {}
    for name, spent in found.items():
        threads = "2 threads" if name == "two" else "chosen threads"
        wall, processor = spent
        ratios[f"{threads} / 1 thread, busy, processor"] = processor / one.processor
        ratios[f"{threads} / 1 thread, busy, wall"] = wall / one.wall
    return ratios


def _count(number: int, word: str) -> str:
    return f"{number} {word}" + ("" if number == 1 else "s")


def profile(workload: Workload, batch: int, threads: int, blocks: int = 3) -> dict[str, Shares]:
    """Shares of a step by method, in their loops."""
    torch.set_num_threads(threads)
    loop = workload.loop(batch)
    for _ in range(WARM):
        loop.block()
    with marked(), profiled() as profiler:
        seconds = sum(wall for wall, _ in loop.block(blocks))
    found = {"wildghand": shares_of(profiler, seconds)}
    marks, profiler, spent = marked(), profiled(), [0.0]

    def after_block(number: int, taken: list[Spent]) -> None:
        if number == WARM - 1:
            marks.__enter__()
            profiler.__enter__()
        elif number >= WARM:
            spent.extend(wall for wall, _ in taken)
        if number == WARM + blocks - 1:
            profiler.__exit__(None, None, None)
            marks.__exit__(None, None, None)

    run_plain(workload.training, workload.plain(batch), WARM + blocks, after_block)
    return found | {"plain": shares_of(profiler, sum(spent))}


def component_table(shares: Mapping[str, Shares], steps: Mapping[str, float], title: str) -> Table:
    """Milliseconds and shares by component, both methods side by side."""
    found = {method: by_component(shares[method]) for method in shares}
    names = sorted(
        {name for table in found.values() for name in table},
        key=lambda name: -sum(found["wildghand"].get(name, {}).values()),
    )
    columns, rows = [Column("component")], []
    passes = ("forward", "backward", "update")
    for method in found:
        columns += [Column(f"{text}, ms", 2, group=method) for text in (*passes, "all")]
        columns.append(Column("%", 1, group=method))
    for name in names:
        row: list[Any] = [name]
        for method, table in found.items():
            parts = table.get(name)
            cells = [None] * 3 if parts is None else [parts.get(text) for text in passes]
            row += [None if cell is None else cell * steps[method] for cell in cells]
            share = None if parts is None else sum(parts.values())
            row += [None, None] if share is None else [share * steps[method], 100.0 * share]
        rows.append(tuple(row))
    whole: list[Any] = ["whole step"]
    for method, table in found.items():
        sums = [sum(parts.get(text, 0.0) for parts in table.values()) for text in passes]
        whole += [*(value * steps[method] for value in sums), steps[method], 100.0]
    return Table(title, tuple(columns), (*rows, tuple(whole)), ranked=False)


def steps_table(steps: Steps) -> Table:
    """Whole steps by frames and threads."""
    columns = [Column("frames in a step"), Column("threads")]
    for method in ("wildghand", "plain"):
        columns += [Column(text, 1, group=f"{method}, ms") for text in ("wall", "processor")]
    columns.append(Column("ratio", 2))
    rows = []
    for (method, batch, count), step in steps.items():
        if method == "wildghand":
            plain = steps["plain", batch, count]
            cells = step.wall, step.processor, plain.wall, plain.processor
            rows.append((batch, count, *cells, step.over(plain, count)))
    return Table("Whole steps", tuple(columns), tuple(rows), ranked=False)


def measure(
    *,
    batches: Sequence[int] = (1, 4),
    threads: Sequence[int] = (1, 2),
    rounds: int = ROUNDS,
    busy: bool = False,
) -> Mapping[str, float]:
    """Ratios of whole steps by name, lower is better: to the plain baseline, to one frame in a
    step, to one thread; or those beside busy processes.

    Args:
        batches: sizes of the batch.
        threads: numbers of threads.
        rounds: turns of each fit.
        busy: measure `beside_busy`, and only that.
    """
    before = torch.get_num_threads()
    try:
        with opened_request(small_capture(None)) as training:
            workload = Workload(training, GAUSSIANS, None)
            if busy:
                return beside_busy(workload, rounds)
            return whole_steps(workload, batches, threads, rounds)[1]
    finally:
        torch.set_num_threads(before)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("capture", nargs="?", help="capture folder (a small one of 176 px)")
    parser.add_argument("--gaussians", type=int, default=GAUSSIANS, help="on each hand")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="to compare (1 2)")
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 4], help="to compare (1 4)")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="turns of each fit")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--busy", action="store_true", help="beside busy processes, and only that")
    parser.add_argument("--json", action="store_true", help="print numbers for programs")
    parser.add_argument("--flame", type=Path, metavar="FILE", help="draw the components: svg, png")
    args = parser.parse_args()
    capture = small_capture(args.capture)
    with opened_request(capture) as training:
        workload = Workload(training, args.gaussians, overrides(args.set))
        if args.busy:
            _print_ratios(beside_busy(workload, args.rounds), args.json)
            return
        found, ratios = whole_steps(workload, args.batch, args.threads, args.rounds)
        batch, count = args.batch[0], args.threads[0]
        shares = profile(workload, batch, count)
    steps = {method: found[method, batch, count].wall for method in shares}
    where = f"{capture.info.id}, {capture.info.width} px, {args.gaussians:,} Gaussians"
    title = f"One step: {where}, {_count(batch, 'frame')}, {_count(count, 'thread')}"
    if args.flame:
        memory = io.BytesIO()
        figure = draw_flames(shares, steps, title)
        figure.savefig(memory, format=args.flame.suffix.removeprefix(".") or "svg", dpi=150)
        atomic_write(args.flame, memory.getvalue())
    if args.json:
        parts = {method: by_component(shares[method]) for method in shares}
        milliseconds = {
            f"{method}, {_count(frames, 'frame')}, {_count(number, 'thread')}": asdict(times)
            for (method, frames, number), times in found.items()
        }
        print(json.dumps({"ratios": ratios, "ms": milliseconds, "shares": parts}, indent=1))
        return
    print_table(component_table(shares, steps, title))
    print_table(steps_table(found))
    _print_ratios(ratios)


def _print_ratios(ratios: Mapping[str, float], as_json: bool = False) -> None:
    if as_json:
        print(json.dumps({"ratios": dict(ratios)}, indent=1))
        return
    rows = tuple(ratios.items())
    print_table(Table("Ratios", (Column("ratio"), Column("", 2)), rows, ranked=False))


if __name__ == "__main__":
    main()
