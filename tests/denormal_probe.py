"""What the threads of a process do with denormals: importable from any process."""

from __future__ import annotations

import argparse
import json
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

#: Halving it gives a denormal.
LEAST = sys.float_info.min


def states() -> dict[str, bool]:
    """Whether each kind of thread flushes all denormals of a product to zero."""
    import numpy as np
    import torch

    from hwp_bench.base.kernels import compiled
    from hwp_bench.base.numerics import flushes

    @compiled()
    def halves(values: np.ndarray) -> float:
        total = 0.0
        for value in values:
            total += 0.5 * value
        return total

    started: list[bool] = []
    thread = threading.Thread(target=lambda: started.append(flushes()))
    thread.start()
    thread.join()
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    least = torch.full((100_000,), LEAST, dtype=torch.float64)
    weight = torch.full((100_000,), 0.5, dtype=torch.float64, requires_grad=True)
    products = least * 0.5
    (weight * least).sum().backward(torch.tensor(0.5, dtype=torch.float64))
    torch.set_num_threads(before)
    assert weight.grad is not None
    left, right = np.full((128, 128), LEAST), np.full((128, 128), 0.5 / 128)
    return {
        "this": flushes(),
        "started": started[0],
        "torch": not products.any(),
        "autograd": not weight.grad.any(),
        "BLAS": not (left @ right).any(),
        "numba": bool(halves(np.full(10, LEAST)) == 0.0),
    }


@dataclass(frozen=True)
class Probe:
    """A job that writes the states of its process."""

    def __call__(self, inputs: Mapping[str, Path], output: Path, on_progress: Any) -> None:
        output.mkdir(parents=True, exist_ok=True)
        (output / "states.json").write_text(json.dumps(states()))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """No arguments: a command of a program."""


def run(args: argparse.Namespace) -> int:
    """Print the states of this process."""
    print(json.dumps(states()))
    return 0
