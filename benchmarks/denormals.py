"""What denormal gradients cost a fit, with and without flushing them to zero.

Run from the repository: `python -m benchmarks.denormals [CAPTURE] [--threads 1] [--rounds 8]`. Two
fits take turns: an ordinary one, and one whose loss is so small that nearly every gradient is a
denormal. Each takes blocks of steps with denormals flushed, as fits do, and without. Numbers are
medians of processor seconds, which other work on the machine hardly changes. What a denormal costs
depends on the processor: next to nothing on AMD's, a hundred cycles and more on many of Intel's.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from benchmarks.small_capture import opened_request, small_capture
from benchmarks.step_loops import WildGHandLoop, mean_of
from hwp_bench.base.tables import Column, Table, print_table
from wildghand.dpd.dpd import DpdSettings
from wildghand.model import terms

#: What the loss is multiplied with, so that gradients of pixels are about 1e-40.
FADED = 1e-35
#: Weights of the loss that are settings.
SETTINGS = {"terms.surface": 5e-4}
#: Those of DPD that are constants.
CONSTANTS: dict[str, Any] = {"gain_weight": 0.1, "tint_weight": 1.0, "omega_weight": 1.0}
#: Those of the other terms.
FADED_WEIGHTS = {
    "ours": terms.TermWeights(
        **{
            name: weight if isinstance(weight, bool) else FADED * weight
            for name, weight in dataclasses.asdict(terms.WEIGHTS["ours"]).items()
        }
    )
}


def processor_ms(
    capture: str | Path | None, gaussians: int, threads: int, rounds: int
) -> dict[tuple[str, bool], float]:
    """Median processor milliseconds of a step by fit (ordinary, faded) and flushing."""
    torch.set_num_threads(threads)
    settings: dict[str, dict[str, Any]] = {
        "ordinary": {"gaussians": gaussians},
        "faded": {"gaussians": gaussians} | {name: FADED * w for name, w in SETTINGS.items()},
    }
    spent: dict[tuple[str, bool], list[float]] = {}
    with opened_request(small_capture(capture)) as training:
        loops = {name: WildGHandLoop(training, values) for name, values in settings.items()}
        for turn in range(rounds + 1):
            for name, loop in loops.items():
                faded = FADED if name == "faded" else 1.0
                constants: dict[str, Any] = {
                    constant: faded * weight for constant, weight in CONSTANTS.items()
                }
                weights = FADED_WEIGHTS if name == "faded" else terms.WEIGHTS
                for flush in (True, False):
                    with (
                        mock.patch.multiple(DpdSettings, **constants),
                        mock.patch.object(terms, "WEIGHTS", weights),
                    ):
                        _, processor = mean_of(loop.block(flush=flush))
                    if turn > 0:
                        spent.setdefault((name, flush), []).append(processor)
    return {key: 1e3 * float(np.median(values)) for key, values in spent.items()}


def ratios(spent: Mapping[tuple[str, bool], float]) -> dict[str, float]:
    """What denormal gradients cost: the step of the faded fit over that of the ordinary one."""
    return {
        "denormal / ordinary gradients, flushed": spent["faded", True] / spent["ordinary", True],
        "denormal / ordinary gradients, not flushed": spent["faded", False]
        / spent["ordinary", False],
    }


def measure() -> Mapping[str, float]:
    """Ratios by name, lower is better: what denormal gradients cost."""
    before = torch.get_num_threads()
    try:
        return ratios(processor_ms(None, gaussians=2_000, threads=1, rounds=6))
    finally:
        torch.set_num_threads(before)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("capture", nargs="?", help="capture folder (a small one of 176 px)")
    parser.add_argument("--gaussians", type=int, default=5_000)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=8, help="turns of each fit")
    parser.add_argument("--json", action="store_true", help="print numbers for programs")
    args = parser.parse_args()
    spent = processor_ms(args.capture, args.gaussians, args.threads, args.rounds)
    found = ratios(spent)
    if args.json:
        print(json.dumps(found, indent=1))
        return
    names = ("ordinary", "faded")
    rows = [
        ("flushed" if flush else "not flushed", *(spent[name, flush] for name in names), ratio)
        for flush, ratio in zip((True, False), found.values(), strict=True)
    ]
    titles = ("denormals", "ordinary gradients, ms", "denormal gradients, ms", "ratio")
    columns = tuple(Column(title, 2) for title in titles)
    print_table(Table("Processor time of a step", columns, tuple(rows), ranked=False))


if __name__ == "__main__":
    main()
