"""Adam with the norm of the gradient clipped: two passes over everything that is fitted.

On the CPU a step of torch's optimizer and of its clipping starts some two hundred operations on
tensors that are mostly tiny. Here all tensors are cut into pieces that compiled code goes through,
on several threads. On other devices torch's own fused step does the work, and nothing is read back.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import carray, types
from torch import Tensor

from hwp_bench.base.kernels import compiled
from wildghand.splat.kernels.groups import GROUP, fill_exact, load1, total
from wildghand.splat.kernels.jit import inline, next_job
from wildghand.splat.kernels.vectors import (
    Vector,
    absolute,
    bits,
    fma,
    intrinsic,
    make_load,
    square_root,
    store,
)
from wildghand.splat.threads import even_jobs, run, thread_count

#: Numbers in a piece, a job of one thread.
PIECE = 16_384

_LANES = 16
_ALL = 2**_LANES - 1
_load = make_load(Vector(types.float32, _LANES))
# Rows of a table of addresses: parameters, gradients, first and second moments, counts of steps.
_VALUES, _GRADIENT, _MEAN, _SQUARE, _STEPS = range(5)


class Pieces(NamedTuple):
    """T tensors, cut into P pieces that are worked on one by one."""

    owner: np.ndarray  # (P,) int64, which tensor a piece is of
    first: np.ndarray  # (P,) int64, where in the tensor it begins
    last: np.ndarray  # (P,) int64, and where it ends


@intrinsic
def _floats(typingctx: Any, address: Any) -> Any:
    """A number as the address of float32 values."""
    kind = types.CPointer(types.float32)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], context.get_value_type(kind))

    return kind(address), codegen


@compiled(nogil=True)
def add_squares(worker, counters, ends, addresses, pieces, sums):
    """Squares of each piece of the gradients, summed into float64 (P,); a job is a piece.

    `addresses` is int64 (5, T): of parameters, gradients, moments and counts.
    """
    while True:
        piece = next_job(worker, counters, ends)
        if piece < 0:
            break
        start, stop = pieces.first[piece], pieces.last[piece]
        values = carray(_floats(addresses[_GRADIENT, pieces.owner[piece]]), (stop,))
        lanes = fill_exact(0.0)
        whole = start + (stop - start) // GROUP * GROUP
        for i in range(start, whole, GROUP):
            (part,) = load1(values, i)
            lanes = lanes + part * part
        found = total(lanes)
        for i in range(whole, stop):
            found += np.float64(values[i]) * np.float64(values[i])
        sums[piece] = found


@compiled()
def advance(addresses, rates, betas, factors):
    """Count a step of every tensor, and find what depends on the count.

    Into float32 (T, 2): minus the rate over the first bias correction, and the root of the second.
    """
    for tensor in range(len(rates)):
        count = carray(_floats(addresses[_STEPS, tensor]), (1,))
        count[0] += np.float32(1.0)
        taken = np.float64(count[0])
        factors[tensor, 0] = -rates[tensor] / (1.0 - betas[0] ** taken)
        factors[tensor, 1] = math.sqrt(1.0 - betas[1] ** taken)


@inline
def _step(arrays, i, scale, rate, root, constants):
    """One step of Adam on 16 numbers, rounded as in torch's kernel."""
    values, gradient, mean, square = arrays
    weight1, beta2, weight2, epsilon = constants
    g, m, s = _load(gradient, i), _load(mean, i), _load(square, i)
    # Where nothing has ever had a gradient nothing can change: most of an identity map is read by
    # no Gaussian. A comparison with NaN is false.
    if bits(absolute(g) + absolute(m) + s <= np.float32(0.0)) == _ALL:
        return
    g = g * scale
    m = fma(g - m, weight1, m)
    s = fma(g * weight2, g, s * beta2)
    store(mean, i, m)
    store(square, i, s)
    store(values, i, _load(values, i) + m * rate / (square_root(s) / root + epsilon))


@compiled(nogil=True)
def update(worker, counters, ends, addresses, pieces, factors, scales, betas, epsilon):
    """One step of Adam on every piece; float32 (T,) `scales` multiply the gradients."""
    constants = (
        np.float32(1.0 - betas[0]),
        np.float32(betas[1]),
        np.float32(1.0 - betas[1]),
        np.float32(epsilon),
    )
    rest = np.zeros((4, _LANES), np.float32)
    while True:
        piece = next_job(worker, counters, ends)
        if piece < 0:
            break
        tensor, start, stop = pieces.owner[piece], pieces.first[piece], pieces.last[piece]
        scale, rate, root = scales[tensor], factors[tensor, 0], factors[tensor, 1]
        values = carray(_floats(addresses[_VALUES, tensor]), (stop,))
        gradient = carray(_floats(addresses[_GRADIENT, tensor]), (stop,))
        mean = carray(_floats(addresses[_MEAN, tensor]), (stop,))
        square = carray(_floats(addresses[_SQUARE, tensor]), (stop,))
        whole = start + (stop - start) // _LANES * _LANES
        for i in range(start, whole, _LANES):
            _step((values, gradient, mean, square), i, scale, rate, root, constants)
        if whole == stop:
            continue
        rest[:] = 0.0
        for i in range(whole, stop):
            k = i - whole
            rest[_VALUES, k], rest[_GRADIENT, k] = values[i], gradient[i]
            rest[_MEAN, k], rest[_SQUARE, k] = mean[i], square[i]
        parts = rest[_VALUES], rest[_GRADIENT], rest[_MEAN], rest[_SQUARE]
        _step(parts, 0, scale, rate, root, constants)
        for i in range(whole, stop):
            k = i - whole
            values[i], mean[i], square[i] = rest[_VALUES, k], rest[_MEAN, k], rest[_SQUARE, k]


# Added to the norm that the limit is divided by, as in torch.
_LEAST_NORM = 1e-6
# Sets of parameters whose tables are kept.
_TABLES = 4
# Numbers that are worth a thread: half a millisecond's work.
_WORTH_A_THREAD = 4 * PIECE


class ClippedAdam(torch.optim.Adam):
    """`torch.optim.Adam`, which clips the norm of the gradient; saved states are the same.

    On the CPU numbers are rounded as in torch's fused step on processors with fused multiply-add.
    The norm is summed in float64 and in an order that does not depend on the number of threads.

    Args:
        groups: as torch takes them; each may have `clipped`, whether its gradients count in the
            norm and are scaled (true where it is left out). Parameters are float32.
        limit: largest norm; 0 leaves gradients as they are.
        betas: shares of the moments that a step keeps.
        epsilon: added to the root of the second moment.

    Source: Kingma and Ba, "Adam: a method for stochastic optimization".
    """

    def __init__(
        self,
        groups: Iterable[dict[str, Any]],
        limit: float = 0.0,
        *,
        betas: tuple[float, float] = (0.9, 0.99),
        epsilon: float = 1e-15,
    ) -> None:
        super().__init__(list(groups), eps=epsilon, betas=betas, fused=True)
        self.limit = limit
        #: By which parameters have a gradient: not all of them have one at every step.
        self._tables: list[_Tables] = []

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """As in torch, without its compiler, which takes two seconds to import and is not used."""
        added = torch.optim.Optimizer.add_param_group
        getattr(added, "__wrapped__", added)(self, param_group)

    def clear(self) -> None:
        """Drop all gradients."""
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

    def take_step(self, loss: Tensor) -> None:
        """Move everything that has a gradient; nothing changes where one is not finite.

        Not on the CPU, this holds for the scalar `loss` too, and nobody waits to learn whether it
        is; on the CPU the caller knows.
        """
        if loss.device.type == "cpu":
            self._step_compiled()
        else:
            self._step_on_device(loss)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from a saved state, also one of `torch.optim.Adam` over the same groups."""
        clipped = [group.get("clipped", True) for group in self.param_groups]
        super().load_state_dict(state_dict)
        for group, held in zip(self.param_groups, clipped, strict=True):
            group["clipped"] = held
        self._tables = []

    def _step_on_device(self, loss: Tensor) -> None:
        gradients = [p.grad for _, p in self._parameters() if p.grad is not None]
        sizes = torch.stack(torch._foreach_norm(gradients, math.inf))
        # Torch's fused kernels read it where it lies, as for a `GradScaler`, and skip the step.
        self.found_inf = (~(loss.detach().isfinite() & sizes.isfinite().all())).float()
        if self.limit > 0.0:
            clipped = [p for group, p in self._parameters() if group.get("clipped", True)]
            torch.nn.utils.clip_grad_norm_(clipped, self.limit)
        self.step()

    def _parameters(self) -> Iterator[tuple[dict[str, Any], Tensor]]:
        """The parameters that have a gradient, each with its group."""
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    yield group, parameter

    @torch.no_grad()
    def _step_compiled(self) -> None:
        chosen = list(self._parameters())
        if not chosen:
            return
        gradients = [_laid_out_alike(parameter) for _, parameter in chosen]
        tables = next((made for made in self._tables if made.are_of(chosen)), None)
        if tables is None:
            moments = [(p, self._moments(p)) for _, p in chosen]
            tables = _Tables(moments, self.defaults["betas"], self.defaults["eps"])
            self._tables = [tables, *self._tables[: _TABLES - 1]]
        clipped = np.array([group.get("clipped", True) for group, _ in chosen])
        rates = np.array([float(group["lr"]) for group, _ in chosen])
        tables.step(gradients, rates, clipped, self.limit)

    def _moments(self, parameter: Tensor) -> dict[str, Tensor]:
        """Count of steps and moments, as torch names and makes them."""
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32)
            state["exp_avg"] = torch.zeros_like(parameter)
            state["exp_avg_sq"] = torch.zeros_like(parameter)
        return state


def _laid_out_alike(parameter: Tensor) -> Tensor:
    """The gradient of a parameter, with its numbers in the parameter's order in memory."""
    gradient = parameter.grad
    assert gradient is not None
    if gradient.is_contiguous() and parameter.is_contiguous():
        return gradient
    if gradient.stride() == parameter.stride():
        return gradient
    return torch.empty_like(parameter).copy_(gradient)


class _Tables:
    """Where tensors lie in memory, and how they are cut into pieces."""

    def __init__(
        self,
        tensors: Sequence[tuple[Tensor, dict[str, Tensor]]],
        betas: tuple[float, float],
        epsilon: float,
    ) -> None:
        self._held, self._betas, self._epsilon = tensors, betas, epsilon
        names = ("exp_avg", "exp_avg_sq", "step")
        rest = [[state[name].data_ptr() for _, state in tensors] for name in names]
        self._addresses = np.zeros((5, len(tensors)), np.int64)
        self._addresses[2:] = rest
        cuts = [
            (owner, first, min(first + PIECE, parameter.numel()))
            for owner, (parameter, _) in enumerate(tensors)
            for first in range(0, parameter.numel(), PIECE)
        ]
        self._pieces = Pieces(*np.array(cuts, np.int64).T.copy())
        self._numbers = sum(parameter.numel() for parameter, _ in tensors)
        self._factors = np.empty((len(tensors), 2), np.float32)
        self._sums = np.empty(len(cuts))

    def are_of(self, chosen: Sequence[tuple[dict[str, Any], Tensor]]) -> bool:
        """Whether these are the parameters."""
        return len(chosen) == len(self._held) and all(
            mine is theirs for (mine, _), (_, theirs) in zip(self._held, chosen, strict=True)
        )

    def step(
        self, gradients: Sequence[Tensor], rates: np.ndarray, clipped: np.ndarray, limit: float
    ) -> None:
        """Take a step with T gradients, contiguous, and their (T,) learning rates.

        (T,) `clipped` says which count in the norm and are scaled; a `limit` of 0 is none.
        """
        addresses, pieces = self._addresses, self._pieces
        addresses[0] = [parameter.data_ptr() for parameter, _ in self._held]
        addresses[1] = [gradient.data_ptr() for gradient in gradients]
        worth = max(1, self._numbers // _WORTH_A_THREAD)
        jobs = even_jobs(len(pieces.owner), min(worth, thread_count(len(pieces.owner))))
        scales = np.ones(len(rates), np.float32)
        run(add_squares, jobs, addresses, pieces, self._sums)
        if not np.isfinite(self._sums).all():
            return
        if limit > 0.0:
            norm = math.sqrt(self._sums[clipped[pieces.owner]].sum())
            scales[clipped] = np.minimum(np.float32(1.0), limit / np.float32(norm + _LEAST_NORM))
        advance(addresses, rates, self._betas, self._factors)
        run(update, jobs, addresses, pieces, self._factors, scales, self._betas, self._epsilon)
