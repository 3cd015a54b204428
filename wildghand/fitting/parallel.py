"""A fit in several processes: each draws its part of every batch, and gradients are averaged.

A batch stays what the settings say, whatever the number of processes: it is split, and the mean
of the parts' gradients is the gradient of the whole, so that steps and rates mean the same.
`torchrun` starts the processes and says through the environment who they are.
"""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import importlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from hwp_bench.base.errors import HwpError, MissingDependency, UsageError

#: Longest that a process waits for the others; only rank 0 imports videos and writes.
TIMEOUT = datetime.timedelta(hours=1)
# Counts, in the store that all processes see, those that have failed.
_FAILED = "failed"


class PeerLost(HwpError):
    """Another process of the fit has ended or cannot be reached."""


class World:
    """The processes of a fit and their messages.

    A single process is a world as well: nothing is sent, and tensors come back as they are.

    Args:
        rank: of this process, from 0.
        size: number of processes.
        device: where tensors are that are sent.
        store: what all processes see.
    """

    def __init__(
        self,
        rank: int = 0,
        size: int = 1,
        device: torch.device | str = "cpu",
        store: Any = None,
    ) -> None:
        self.rank = rank
        self.size = size
        self.device = torch.device(device)
        self._store = store

    @property
    def is_main(self) -> bool:
        """Whether this is rank 0, which writes files and prints messages."""
        return self.rank == 0

    def shard(self, count: int) -> slice:
        """The places in a batch of `count` that this process works on."""
        # The mean of the means of unequal parts would not be the mean.
        if count % self.size:
            raise UsageError(
                f"is {count}, which {self.size} processes cannot share evenly",
                field="schedule.batch",
                remedy=f"Give --set schedule.batch={self.size}, or a multiple of it.",
            )
        each = count // self.size
        return slice(self.rank * each, (self.rank + 1) * each)

    def average_(self, tensor: Tensor) -> Tensor:
        """Replace a tensor by its mean over the processes; every process gets the same."""
        if self.size == 1:
            return tensor
        with _talking():
            torch.distributed.all_reduce(tensor)
        return tensor.div_(self.size)

    def gather(self, tensor: Tensor) -> Tensor:
        """Join the parts of all processes along the first dimension, in order; no gradient."""
        if self.size == 1:
            return tensor
        parts = [torch.empty_like(tensor) for _ in range(self.size)]
        with _talking():
            torch.distributed.all_gather(parts, tensor.detach().contiguous())
        return torch.cat(parts)

    def broadcast(self, value: float) -> float:
        """Rank 0's value of a number; waits until rank 0 is here."""
        if self.size == 1:
            return value
        sent = torch.tensor(value, dtype=torch.float64, device=self.device)
        with _talking():
            torch.distributed.broadcast(sent, src=0)
            return float(sent)

    def wait_for_main(self) -> None:
        """Wait until rank 0 is here."""
        self.broadcast(0.0)

    def require_same(self, digest: str) -> None:
        """Check that all processes are about to do the same."""
        own = torch.tensor(list(bytes.fromhex(digest)), dtype=torch.uint8, device=self.device)
        found = self.gather(own[None])
        other = (found != found[0]).any(dim=1).nonzero().flatten().tolist()
        if other:
            raise HwpError(
                f"process {other[0]} of {self.size} starts from another state than process 0",
                remedy="All must see the same files and run the same versions of the packages.",
            )

    def speaks_first(self) -> bool:
        """Whether this is the first process to report that the fit has failed."""
        if self._store is None:
            return True
        try:
            return self._store.add(_FAILED, 1) == 1
        except RuntimeError:  # what held the store is gone
            return False


#: One process by itself.
SINGLE_PROCESS = World()


def average_gradients(parameters: Iterable[Tensor], world: World) -> None:
    """Replace gradients by their means over the processes, in one message.

    A parameter that no process has a gradient for stays without one; where some have none (no
    frame of theirs reaches it) theirs counts as zero.
    """
    if world.size == 1:
        return
    listed: Sequence[Tensor] = list(parameters)
    reached = torch.tensor(
        [float(tensor.grad is not None) for tensor in listed], device=world.device
    )
    pieces = [
        tensor.new_zeros(tensor.numel()) if tensor.grad is None else tensor.grad.flatten()
        for tensor in listed
    ]
    mean = world.average_(torch.cat([reached, *pieces]))
    means = mean[len(listed) :].split([tensor.numel() for tensor in listed])
    for tensor, values, seen in zip(listed, means, mean[: len(listed)].tolist(), strict=True):
        if seen:
            tensor.grad = values.view_as(tensor)


def digest_of(numbers: Mapping[str, Tensor], step: int) -> str:
    """SHA-256 of named tensors and a number of steps."""
    digest = hashlib.sha256(str(step).encode())
    for name, tensor in numbers.items():
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def run_in_world(choose: Callable[[], torch.device], work: Callable[[World], int]) -> int:
    """Do a piece of work together with the processes that were started with this one.

    When one fails, all end; the first to fail says why, the others end silently.
    """
    world = None
    try:
        world = join(choose())
        status = work(world)
    except (Exception, KeyboardInterrupt) as error:
        speaks = False
        # `torchrun` stops all others as soon as one has ended: those have nothing to say either.
        with contextlib.suppress(KeyboardInterrupt):
            speaks = _speaks_first(world)
            if not speaks:
                _leave()
        if speaks:
            raise
        stopped = 130 if isinstance(error, KeyboardInterrupt) else 1
        return error.exit_status if isinstance(error, HwpError) else stopped
    finally:
        _leave()
    return status


def _speaks_first(world: World | None) -> bool:
    """Whether this process reports the failure of all; None before they are connected."""
    if world is not None:
        return world.speaks_first()
    # They fail alike: the first of them speaks for all.
    return os.environ.get("WORLD_SIZE", "1") == "1" or os.environ.get("RANK", "0") == "0"


def join(device: torch.device) -> World:
    """Meet the processes that `torchrun` started; without it there is one process.

    NCCL connects GPUs, one for each process of a machine; gloo connects CPUs.
    """
    size = _number("WORLD_SIZE", 1)
    if size <= 1:
        return SINGLE_PROCESS
    if not torch.distributed.is_available():
        raise MissingDependency(
            "this build of torch lacks torch.distributed, which several processes need",
            remedy="Install one that has it, or start one process, without torchrun.",
        )
    if device.type == "cuda":
        _own_gpu(_number("LOCAL_RANK", 0), _number("LOCAL_WORLD_SIZE", size))
    # Its functions have the group that exists when it is first imported as a default value, and
    # optimizers import it. A group that anything still holds outlives `_leave`.
    importlib.import_module("torch.distributed.nn")
    try:
        store, rank, size = next(iter(torch.distributed.rendezvous("env://")))
        torch.distributed.init_process_group(
            "nccl" if device.type == "cuda" else "gloo",
            store=torch.distributed.PrefixStore("group", store),
            rank=rank,
            world_size=size,
            timeout=TIMEOUT,
        )
    except (RuntimeError, ValueError) as error:
        raise HwpError(
            f"the {size} processes of the fit cannot meet ({str(error).splitlines()[0][:200]})",
            remedy="Start them with torchrun; docs/wildghand.md has the command.",
        ) from error
    return World(rank, size, device, store)


def _leave() -> None:
    """Leave the other processes, and end the threads that talked to them.

    Such a thread returns tensors to Python. If it still runs when the interpreter ends, the
    process is aborted although its work is done.
    """
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


def _own_gpu(place: int, processes: int) -> None:
    gpus = torch.cuda.device_count()
    if processes > gpus:
        raise UsageError(
            f"{processes} processes were started on a machine with {gpus} GPUs",
            remedy=f"Start at most {gpus}, one for each.",
        )
    torch.cuda.set_device(place)


def _number(name: str, otherwise: int) -> int:
    text = os.environ.get(name, str(otherwise))
    if not text.isdecimal():
        raise UsageError(f"is {text!r}, not a number", field=name, remedy="torchrun sets it.")
    return int(text)


@contextlib.contextmanager
def _talking() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        raise PeerLost(
            "another process of the fit ended or cannot be reached",
            remedy="The same command continues with the state that was saved last.",
        ) from error
