"""Times of the rasterizer, compared with the PyTorch reference, gsplat and others.

Run from the repository: `python -m benchmarks.splat [--rounds 30] [--scaling] [--out FOLDER]`.
All contenders take turns in one run, so that other work on the machine slows them alike; the
processor time is what they cost whatever else runs. The floor is the time that the blended pairs
would take if the processor did nothing but multiply and add, as fast as it is measured to.

`--other MODULE:FUNCTION` adds any function (means, quats, scales, opacities, colors, viewmats, Ks,
width, height, backgrounds) -> images.
"""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.splat_workloads import SIZES, Workload, make
from hwp_bench.base.tables import Column, Table, print_table, to_markdown
from wildghand.splat import rasterize

#: Multiplications and additions of one channel-less pair and its three colours, both passes: as the
#: kernels do them, a fused pair counting once.
OPERATIONS_PER_PAIR = 17 + 37
#: (Gaussian, pixel) pairs above which the brute-force reference is left out.
REFERENCE_LIMIT = 1e8
#: Sizes of the scaling study.
COUNTS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
SIDES = (64, 128, 256, 512, 1024, 2048)

Draw = Callable[[dict[str, torch.Tensor], int], torch.Tensor]


@dataclass(frozen=True)
class Contender:
    """One way to draw."""

    name: str
    draw: Draw
    views: int = 1


@dataclass
class Times:
    """Seconds of every turn: forward, backward, and processor time of both."""

    rows: list[tuple[float, float, float]]

    def median_ms(self) -> tuple[float, float, float, float, float]:
        """Forward, backward, total, best total, processor."""
        rows = 1e3 * np.array(self.rows)
        total = rows[:, 0] + rows[:, 1]
        forward, backward, processor = np.median(rows, axis=0)
        return forward, backward, float(np.median(total)), float(total.min()), processor


def ours(backend: str) -> Draw:
    def draw(tensors: dict[str, Any], size: int) -> torch.Tensor:
        return rasterize(**tensors, width=size, height=size, backend=backend)[0]

    return draw


def bare_gsplat(tensors: dict[str, torch.Tensor], size: int) -> torch.Tensor:
    import gsplat

    return gsplat.rasterization(**tensors, width=size, height=size, packed=False)[0]


def other(source: str) -> Contender:
    module, _, function = source.partition(":")
    call = getattr(importlib.import_module(module), function)
    return Contender(source, lambda tensors, size: call(**tensors, width=size, height=size))


def contenders(args: argparse.Namespace) -> list[Contender]:
    if args.device == "cuda":
        found = [Contender("gsplat backend", ours("gsplat")), Contender("bare gsplat", bare_gsplat)]
        found += [
            Contender("gsplat backend, 4 views", ours("gsplat"), 4),
            Contender("bare gsplat, 4 views", bare_gsplat, 4),
        ]
    else:
        found = [Contender("numba", ours("numba")), Contender("numba, 4 views", ours("numba"), 4)]
        found.append(Contender("PyTorch reference", ours("reference")))
    return found + [other(source) for source in args.other]


def one_turn(contender: Contender, workload: Workload, upstream: torch.Tensor) -> list[Any]:
    """Forward, backward and processor seconds, then the image."""
    leaves = {
        name: value.detach().clone().requires_grad_(name != "Ks")
        for name, value in workload.views(contender.views).items()
    }
    wait = torch.cuda.synchronize if upstream.is_cuda else lambda: None
    wait()
    start, processor = time.perf_counter(), time.process_time()
    image = contender.draw(leaves, workload.size)
    wait()
    middle = time.perf_counter()
    image.backward(upstream)
    wait()
    end = time.perf_counter()
    return [middle - start, end - middle, time.process_time() - processor, image.detach()]


def race(found: Sequence[Contender], workload: Workload, rounds: int) -> dict[str, Times]:
    """Times of all contenders, in turns."""
    device = workload.arguments["means"].device
    shape = (4, workload.size, workload.size, 3)
    upstream = torch.randn(shape, generator=torch.Generator().manual_seed(0)).to(device)
    size = len(workload.arguments["means"]) * workload.size**2
    taking_part, truth = [], None
    for contender in found:
        if contender.name == "PyTorch reference" and size > REFERENCE_LIMIT:
            continue
        image = one_turn(contender, workload, upstream[: contender.views])[-1][:1]
        truth = image if truth is None else truth
        if (image - truth).norm() > 1e-3 * truth.norm():
            raise SystemExit(f"{contender.name} draws another image than {found[0].name}")
        taking_part.append(contender)
    times = {contender.name: Times([]) for contender in taking_part}
    for turn in range(rounds):
        for contender in taking_part:
            if contender.name == "PyTorch reference" and turn > 0:
                continue
            row = one_turn(contender, workload, upstream[: contender.views])
            times[contender.name].rows.append(tuple(row[:3]))
    return times


def operations_per_second(threads: int) -> float:
    """Fused multiply-adds a second that the processor does at best, all threads together."""
    from wildghand.splat.kernels.jit import kernel
    from wildghand.splat.kernels.tiles import LANES, fill_pixels
    from wildghand.splat.kernels.vectors import fma, store
    from wildghand.splat.threads import even_jobs, run

    @kernel
    def multiply_add(worker, counters, ends, out):  # type: ignore[no-untyped-def]
        factor = fill_pixels(np.float32(0.9999))
        a = b = c = d = e = f = g = h = i = j = factor
        for _ in range(1_000_000):
            a, b, c = fma(a, factor, factor), fma(b, factor, factor), fma(c, factor, factor)
            d, e, f = fma(d, factor, factor), fma(e, factor, factor), fma(f, factor, factor)
            g, h, i = fma(g, factor, factor), fma(h, factor, factor), fma(i, factor, factor)
            j = fma(j, factor, factor)
        store(out, 0, a + b + c + d + e + f + g + h + i + j)

    out = np.zeros(LANES, np.float32)
    best = np.inf
    for _ in range(5):
        start = time.process_time()
        run(multiply_add, even_jobs(threads, threads), out)
        best = min(best, (time.process_time() - start) / threads)
    return threads * 10 * 1_000_000 * LANES / best


def memory_mib(name: str, threads: int) -> float | None:
    """Peak memory of a forward and backward pass above the memory before it, in a new process."""
    if not Path("/proc/self/clear_refs").exists():
        return None
    words = ["--memory-of", name, "--threads", str(threads)]
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.splat", *words],
        capture_output=True,
        text=True,
        check=True,
    )
    return float(done.stdout.split()[-1])


def print_memory(name: str) -> None:
    tiny, workload = make(100, 16), make(*SIZES[name])
    contender = Contender("numba", ours("numba"))
    one_turn(contender, tiny, torch.ones(1, 16, 16, 3))  # compiled, and threads started
    upstream = torch.ones(1, workload.size, workload.size, 3)
    Path("/proc/self/clear_refs").write_text("5")  # forgets the peak so far (Linux)
    before = peak_kib()
    for _ in range(5):
        one_turn(contender, workload, upstream)
    print((peak_kib() - before) / 1024)


def peak_kib() -> int:
    """Peak resident memory of this process, KiB (Linux)."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM")))


def table_of(args: argparse.Namespace) -> Table:
    found = contenders(args)
    speed = operations_per_second(args.threads) if args.device == "cpu" else None
    rows: list[tuple[Any, ...]] = []
    for name in args.workloads:
        workload = make(*SIZES[name])
        workload = Workload(
            {key: value.to(args.device) for key, value in workload.arguments.items()}, workload.size
        )
        times = race(found, workload, args.rounds)
        floor = memory = None
        if speed is not None:
            *_, info = rasterize(
                **workload.arguments, width=workload.size, height=workload.size, count_pairs=True
            )
            floor = 1e3 * float(info["pairs"].sum()) * OPERATIONS_PER_PAIR / speed
            memory = memory_mib(name, args.threads)
        first = times[found[0].name].median_ms()
        for k, (contender, taken) in enumerate(times.items()):
            forward, backward, total, best, processor = taken.median_ms()
            views = next(one.views for one in found if one.name == contender)
            rows.append((
                name, contender, forward, backward, total, best, processor,
                total / first[2], processor / first[4],
                None if floor is None else total / views / floor, memory if k == 0 else None,
            ))  # fmt: skip
    titles = (
        "workload", "contender", "forward ms", "backward ms", "total ms", "best ms",
        "processor ms", "ratio", "processor ratio", "x floor", "memory MiB",
    )  # fmt: skip
    columns = tuple(Column(title, digits=1 if "ms" in title or "M" in title else 2)
                    for title in titles)  # fmt: skip
    note = (
        f"Medians of {args.rounds} turns, {args.threads} threads; ratios to the first contender; "
        "4 views are drawn in one call."
    )
    return Table("Rasterizer, forward and backward", columns, tuple(rows), (note,))


def measure(name: str = "W3", rounds: int = 20) -> Mapping[str, float]:
    """Ratios of processor seconds by name, lower is better, on one thread.

    Args:
        name: of the workload.
        rounds: turns of each contender.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        workload = make(*SIZES[name])
        found = [Contender("one", ours("numba")), Contender("four", ours("numba"), 4)]
        times = {key: taken.median_ms()[-1] for key, taken in race(found, workload, rounds).items()}
        speed = operations_per_second(1)
        size = workload.size
        *_, info = rasterize(**workload.arguments, width=size, height=size, count_pairs=True)
        floor = 1e3 * float(info["pairs"].sum()) * OPERATIONS_PER_PAIR / speed
        return {
            "one view / floor": times["one"] / floor,
            "four views / one": times["four"] / times["one"],
        }
    finally:
        torch.set_num_threads(before)


def scaling(args: argparse.Namespace) -> dict[str, list[dict[str, float]]]:
    """Times over the number of Gaussians, and over the covered pixels."""
    contender = Contender("numba", ours("numba"))
    studies = {
        "gaussians": [(count, 512, 1.0) for count in COUNTS],
        "pixels": [(49_281, side, side / 512) for side in SIDES],
    }
    result: dict[str, list[dict[str, float]]] = {}
    for study, settings in studies.items():
        for count, side, splat in settings:
            workload = make(count, side, splat)
            rounds = max(3, args.rounds // 4)
            forward, backward, total, best, processor = race([contender], workload, rounds)[
                "numba"
            ].median_ms()
            *_, info = rasterize(**workload.arguments, width=side, height=side, count_pairs=True)
            row = {
                "gaussians": count, "side": side, "pairs": float(info["pairs"].sum()),
                "forward_ms": forward, "backward_ms": backward, "total_ms": total,
                "best_ms": best, "processor_ms": processor,
            }  # fmt: skip
            result.setdefault(study, []).append(row)
            print(f"{study}: {count:>9,} Gaussians, {side:>4} px: {total:8.1f} ms", file=sys.stderr)
    return result


def plot(result: dict[str, list[dict[str, float]]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(10, 4), constrained_layout=True)
    labels = {"gaussians": "Gaussians (512 px)", "pixels": "pixels (49,281 Gaussians)"}
    for axis, (study, rows) in zip(axes, result.items(), strict=True):
        x = [row["gaussians"] if study == "gaussians" else row["side"] ** 2 for row in rows]
        for key in ("forward_ms", "backward_ms", "total_ms"):
            axis.loglog(x, [row[key] for row in rows], "o-", label=key.removesuffix("_ms"))
        last = rows[-1]["total_ms"]
        axis.loglog(x, [last * value / x[-1] for value in x], "k:", label="linear")
        axis.set(xlabel=labels[study], ylabel="ms (median)")
        axis.grid(alpha=0.3)
        axis.legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--workloads", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--rounds", type=int, default=30, help="turns of each contender (30)")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="CPU threads")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--other", action="append", default=[], metavar="MODULE:FUNCTION")
    parser.add_argument("--scaling", action="store_true", help="1k-1M Gaussians, 64-2048 px")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="keep table, numbers, plot here")
    parser.add_argument("--memory-of", choices=SIZES, help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    if args.memory_of:
        print_memory(args.memory_of)
        return
    table = table_of(args)
    print_table(table)
    result = scaling(args) if args.scaling else None
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        (args.out / f"table-{args.device}.md").write_text(to_markdown(table), encoding="utf-8")
        if result:
            (args.out / "scaling.json").write_text(json.dumps(result, indent=1) + "\n")
            plot(result, args.out / "scaling.png")


if __name__ == "__main__":
    main()
