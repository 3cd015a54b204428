"""The part that runs on a node of a Ray cluster: find the inputs, do the job, send the result."""

from __future__ import annotations

import contextlib
import socket
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.base.files import cache_root, files_digest
from hwp_bench.base.numerics import flushed
from hwp_bench.base.packages import PACKAGES
from hwp_bench.run.engine.job import RETRIES, Work
from hwp_bench.run.engine.parcel import Parcel, folder_digest, pack, unpack
from hwp_bench.run.engine.process import (
    VISIBLE_GPUS,
    LocalJob,
    WorkerLost,
    error_record,
    run_in_process,
)

#: Packages and folders whose source decides what a job does.
SOURCES = ("hwp_bench", "wildghand", "baselines")
#: Endings of that source: programs, settings, and the free hand.
SUFFIXES = {".py", ".toml", ".npz"}


@dataclass(frozen=True)
class Input:
    """A folder that a job reads, by content."""

    #: Digest of its content.
    digest: str
    #: Where it lies on the machine that orders; None where nodes must not look there.
    path: str | None
    #: Names directly inside it that do not count.
    skip: tuple[str, ...] = ()


@dataclass(frozen=True)
class Order:
    """A job on its way to a node."""

    #: Number of this order; a job that is ordered again gets a new one.
    number: int
    #: The work.
    work: Work
    #: The folders that it reads, by name.
    inputs: Mapping[str, Input]
    #: Environment variables of the job.
    environment: Mapping[str, str]
    #: Whether it may use the GPUs that Ray gives it.
    gpus: bool
    #: Digest of the toolkit that ordered it.
    toolkit: str


@dataclass(frozen=True)
class Reply:
    """The answer of a node: a result, or the names of missing inputs, or an error."""

    #: The result folder.
    result: Parcel | None = None
    #: Names of inputs that must be sent.
    missing: tuple[str, ...] = ()
    #: Kind, problem, where, field and remedy of an error.
    failure: Mapping[str, str | None] = field(default_factory=dict)


def toolkit_digest() -> str:
    """Return the SHA-256 (hex) of the toolkit's source: what decides results besides inputs."""
    root = PACKAGES
    files = (path for package in SOURCES for path in (root / package).rglob("*"))
    return files_digest(
        root, (path for path in files if path.suffix in SUFFIXES and path.is_file())
    )


@flushed()
def run_order(order: Order, sent: Mapping[str, list[Any]], board: Any) -> Reply:
    """Do a job on this node.

    Args:
        order: the job.
        sent: for inputs that were asked for, a reference to the `Parcel`; in a list, so that Ray
            brings it only when it is needed.
        board: actor that is told how far the job is.

    Returns:
        The result; errors of the job itself are returned too, since Ray would wrap them.
    """
    import ray

    place = f"{socket.gethostname()}/{ray.get_runtime_context().get_node_id()[:6]}"
    tell = partial(board.update.remote, order.number, place)
    tell(0, 0)
    try:
        if toolkit_digest() != order.toolkit:
            raise HwpError(
                "this node has another version of the toolkit",
                where=place,
                remedy="Install the same version on every node.",
            )
        inputs, missing = _find_inputs(order, sent)
        if missing:
            return Reply(missing=missing)
        return Reply(result=_run(order, inputs, tell))
    except HwpError as error:
        return Reply(failure=error_record(error))


def _find_inputs(
    order: Order, sent: Mapping[str, list[Any]]
) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Return where inputs lie on this node, and which must be sent."""
    import ray

    found: dict[str, Path] = {}
    missing = []
    for name, ordered in order.inputs.items():
        cached = cache_root() / "engine" / "inputs" / ordered.digest
        if cached.is_dir():
            found[name] = cached
        elif _is_shared(ordered):
            found[name] = Path(str(ordered.path))
        elif name in sent:
            parcel = ray.get(sent[name][0])
            if parcel.digest != ordered.digest:
                raise BadInput("another folder was sent than the one that was ordered", field=name)
            unpack(parcel, cached)
            found[name] = cached
        else:
            missing.append(name)
    return found, tuple(missing)


def _is_shared(ordered: Input) -> bool:
    """Whether the folder lies at the same place here, on a file system that nodes share."""
    if ordered.path is None or not Path(ordered.path).is_dir():
        return False
    try:
        return folder_digest(Path(ordered.path), ordered.skip) == ordered.digest
    except HwpError:
        return False


def _run(order: Order, inputs: Mapping[str, Path], tell: Any) -> Parcel:
    environment = dict(order.environment)
    if not order.gpus:
        environment[VISIBLE_GPUS] = ""
    with tempfile.TemporaryDirectory(prefix="hwp-engine-") as name:
        scratch = Path(name)
        output = scratch / "result"
        job = LocalJob(order.work, inputs, output, environment, (scratch,))
        for attempt in range(RETRIES + 1):
            with contextlib.suppress(WorkerLost):
                run_in_process(job, tell, lambda: False)
                break
            if attempt == RETRIES:
                raise HwpError(
                    f"the process of a job was killed {RETRIES + 1} times",
                    where=socket.gethostname(),
                    remedy="Is there enough memory? Ask for more processors with --job-cpus.",
                )
        return pack(output)


class Board:
    """The last news of every order; lives on the node that gave the orders."""

    def __init__(self) -> None:
        self._last: dict[int, tuple[str, int, int]] = {}

    def update(self, number: int, place: str, done: int, total: int) -> None:
        """Note how far an order is."""
        self._last[number] = (place, done, total)

    def read(self) -> dict[int, tuple[str, int, int]]:
        """Return (place, done, total) by number."""
        return dict(self._last)
