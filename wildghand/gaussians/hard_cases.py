"""Hard cases of the optimizer, for `hwp-bench dev stability` and for the tests.

Each compares with Adam in float64 numpy (Kingma and Ba, algorithm 1) behind a clipped norm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from hwp_bench.stability import CaseGroup, Measured, largest
from wildghand.gaussians.adam import ClippedAdam

#: Largest difference of a parameter from float64, as a share of the step's size.
TOLERANCE = 1e-4
_BETAS, _EPSILON, _RATE = (0.9, 0.99), 1e-15, 0.01
_AS_FLOAT64 = f"finite, to {TOLERANCE:g} of a step of float64"
_SKIPPED = "the step is skipped and says so; parameters, moments and their count stay"

#: Every hard case of the optimizer.
cases = CaseGroup("optimizer")


@dataclass
class _Oracle:
    """Adam in float64; each parameter is (N,)."""

    values: list[np.ndarray]
    limit: float
    means: list[np.ndarray] = field(default_factory=list)
    squares: list[np.ndarray] = field(default_factory=list)
    steps: int = 0

    def step(self, gradients: Sequence[np.ndarray]) -> None:
        """Clip the norm over all gradients, then move."""
        wide = [gradient.astype(np.float64) for gradient in gradients]
        norm = math.sqrt(sum(float((one**2).sum()) for one in wide))
        factor = min(1.0, self.limit / (norm + 1e-6)) if self.limit else 1.0
        self.means = self.means or [np.zeros_like(one) for one in wide]
        self.squares = self.squares or [np.zeros_like(one) for one in wide]
        self.steps += 1
        first, second = _BETAS
        for value, gradient, mean, square in zip(
            self.values, wide, self.means, self.squares, strict=True
        ):
            mean[:] = first * mean + (1.0 - first) * factor * gradient
            square[:] = second * square + (1.0 - second) * (factor * gradient) ** 2
            root = np.sqrt(square / (1.0 - second**self.steps)) + _EPSILON
            value -= _RATE * mean / (1.0 - first**self.steps) / root


def _start(limit: float) -> tuple[list[torch.Tensor], ClippedAdam, _Oracle]:
    generator = torch.Generator().manual_seed(0)
    tensors = [torch.randn(n, generator=generator).requires_grad_() for n in (5, 64, 1)]
    optimizer = ClippedAdam(
        [{"params": [tensor], "lr": _RATE} for tensor in tensors],
        limit,
        betas=_BETAS,
        epsilon=_EPSILON,
    )
    return tensors, optimizer, _Oracle([_array(tensor) for tensor in tensors], limit)


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().double().numpy().copy()


def _apart(tensor: torch.Tensor, values: np.ndarray) -> float:
    return float(np.abs(_array(tensor) - values).max())


def _gradients(tensors: Sequence[torch.Tensor], size: float, seed: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    made = [torch.randn(tensor.shape, generator=generator) for tensor in tensors]
    widest = largest(float(one.abs().max()) for one in made)
    return [(one.double() / widest * size).float() for one in made]


def _follow(sizes: Sequence[float], limit: float) -> Measured:
    """Steps with gradients of some sizes, next to float64."""
    tensors, optimizer, oracle = _start(limit)
    off, skipped = 0.0, 0.0
    for seed, size in enumerate(sizes):
        given = _gradients(tensors, size, seed)
        for tensor, gradient in zip(tensors, given, strict=True):
            tensor.grad = gradient.clone()
        oracle.step([gradient.numpy() for gradient in given])
        skipped += float(optimizer.take_step(torch.zeros(())))
        pairs = zip(tensors, oracle.values, strict=True)
        off = largest([off, *(_apart(one, other) for one, other in pairs)])
    finite = all(bool(tensor.isfinite().all()) for tensor in tensors)
    share = off / _RATE
    return Measured(finite and not skipped and share <= TOLERANCE, f"off by {share:.0e} of a step")


@cases.case("gradients of {0:g}, clipped at {1:g}", _AS_FLOAT64, (1.0, 0.0), (1.0, 0.5), (1e6, 1.0))
@cases.case("gradients of {0:g}, clipped at {1:g}", _AS_FLOAT64, (1e-7, 0.0), (1e-12, 1.0))
@cases.case(
    "denormal gradients of {0:g}, clipped at {1:g}", _AS_FLOAT64, (1e-38, 0.0), (1e-42, 1.0)
)
@cases.case("large gradients of {0:g}, clipped at {1:g}", _AS_FLOAT64, (1e17, 0.0), (1e17, 1.0))
def _run_sizes(size: float, limit: float) -> Measured:
    return _follow([size] * 6, limit)


@cases.case("gradients that jump from {0:g} to {1:g}", _AS_FLOAT64, (1e-6, 1e3), (1e3, 1e-6))
def _run_jump(first: float, second: float) -> Measured:
    return _follow([first] * 3 + [second] * 3, 1.0)


@cases.case("gradients of 0, clipped at {:g}", "nothing moves, nothing is skipped", 0.0, 1.0)
def _run_zero(limit: float) -> Measured:
    tensors, optimizer, _ = _start(limit)
    before = [_array(tensor) for tensor in tensors]
    for _ in range(3):
        for tensor in tensors:
            tensor.grad = torch.zeros_like(tensor)
        stopped = float(optimizer.take_step(torch.zeros(())))
    same = all(np.array_equal(_array(a), b) for a, b in zip(tensors, before, strict=True))
    return Measured(same and not stopped, f"{optimizer.state[tensors[0]]['step']:g} steps")


@cases.case("one gradient of {0:g}, clipped at {1:g}", _SKIPPED, (1e30, 0.0), (3e38, 1.0))
def _run_huge(size: float, limit: float) -> Measured:
    return _skip(limit, size, 0.0)


@cases.case("one {} among the gradients, clipped at {}", _SKIPPED, ("NaN", 0.0), ("NaN", 1.0))
@cases.case("one {} among the gradients, clipped at {}", _SKIPPED, ("inf", 0.0), ("inf", 1.0))
@cases.case("one {} among the gradients, clipped at {}", _SKIPPED, ("-inf", 1.0))
def _run_not_finite(name: str, limit: float) -> Measured:
    return _skip(limit, float(name), 0.0)


@cases.case("a loss of {}", _SKIPPED, "NaN", "inf")
def _run_loss(name: str) -> Measured:
    return _skip(1.0, 0.0, float(name))


def _skip(limit: float, bad: float, loss: float) -> Measured:
    """A sound step, a bad one, and a sound one: as if the bad one had not been."""
    tensors, optimizer, oracle = _start(limit)
    said = []
    for seed in range(3):
        given = _gradients(tensors, 1.0, seed)
        for tensor, gradient in zip(tensors, given, strict=True):
            tensor.grad = gradient.clone()
        if seed == 1:
            if bad and tensors[1].grad is not None:
                tensors[1].grad[7] = bad
        else:
            oracle.step([gradient.numpy() for gradient in given])
        said.append(float(optimizer.take_step(torch.tensor(loss if seed == 1 else 0.0))))
    pairs = zip(tensors, oracle.values, strict=True)
    off = largest(_apart(one, other) for one, other in pairs) / _RATE
    count = float(optimizer.state[tensors[0]]["step"])
    passed = said == [0.0, 1.0, 0.0] and count == 2.0 and off <= TOLERANCE
    return Measured(passed, f"off by {off:.0e} of a step, {count:g} steps counted")


@cases.case("a tensor without a gradient, and one without numbers", _AS_FLOAT64)
def _run_absent() -> Measured:
    tensors, _, oracle = _start(1.0)
    empty, alone = torch.zeros(0).requires_grad_(), torch.ones(3).requires_grad_()
    optimizer = ClippedAdam(
        [{"params": [*tensors, empty, alone], "lr": _RATE}], 1.0, betas=_BETAS, epsilon=_EPSILON
    )
    given = _gradients(tensors, 1.0, 0)
    for tensor, gradient in zip(tensors, given, strict=True):
        tensor.grad = gradient.clone()
    empty.grad = torch.zeros(0)
    oracle.step([gradient.numpy() for gradient in given])
    stopped = float(optimizer.take_step(torch.zeros(())))
    pairs = zip(tensors, oracle.values, strict=True)
    off = largest(_apart(one, other) for one, other in pairs) / _RATE
    passed = not stopped and bool((alone == 1.0).all()) and off <= TOLERANCE
    return Measured(passed, f"off by {off:.0e} of a step")
