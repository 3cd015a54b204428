"""A fit in two processes; oracle: one process with the same batch, and the same two again."""

from __future__ import annotations

import contextlib
import json
import math
import multiprocessing
import os
import socket
import subprocess
import sys
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from painted import FRAMES, SilentReport, TrainingMaker
from tiny_fits import TINY, UNJUDGED

from hwp_bench.base.errors import HwpError, MissingDependency, UsageError
from hwp_bench.capture import Capture
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.methods.contract import Budget, RunSettings
from hwp_bench.methods.request import open_request, write_request
from wildghand.avatar.files import load_avatar
from wildghand.fitting import parallel, session
from wildghand.fitting.components import make_fit
from wildghand.fitting.fit import Component
from wildghand.fitting.method import WildGHandMethod
from wildghand.fitting.parallel import SINGLE_PROCESS, World, average_gradients, join, run_in_world
from wildghand.fitting.session import load_state, run_resumed, save_state
from wildghand.model.settings import read_settings
from wildghand.plain.loop import Watchers, run_fit

SHORT: dict[str, Any] = {**TINY, "schedule.steps": 4, "schedule.batch": 2}
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    # What precedes the first step is the same in all processes, and compared in the default.
    "unjudged": UNJUDGED,
    # Three frames in ten keep no biases: processes must draw the same chances.
    "paper": {"mode": "paper", "schedule.epochs": 0},
}
#: Steps that share the gradient of the texture by fours.
BLOCKS = {**UNJUDGED, "schedule.steps": 8, "schedule.texture_every": 4}
State = dict[str, torch.Tensor]
CPU = torch.device("cpu")


def fitted(request: Path, changes: dict[str, Any], world: World) -> tuple[State, State]:
    """Return the parameters before the first step and after the last."""
    settings = read_settings({**SHORT, **changes})
    fit = make_fit(open_request(request), settings, 0, CPU, world)
    fit.require_same(0)
    start = fit.model.snapshot()
    return start, run_fit(fit, Budget(), SilentReport()).model.snapshot()


def resumed(request: Path, world: World, state: Path) -> State:
    """Two steps, a saved state, and the rest from it."""
    settings = read_settings({**SHORT, **VARIANTS["unjudged"]})
    half, watchers = make_fit(open_request(request), settings, 0, CPU, world), Watchers()

    def save(step: int, watched: Watchers, loss: object) -> None:
        if step == 2 and world.is_main:
            save_state(state, half, watched, step=step, seconds=0.0, digest="d")

    run_fit(half, Budget(), SilentReport(), watchers=watchers, after_step=save)
    world.wait_for_main()
    rest, watchers = make_fit(open_request(request), settings, 0, CPU, world), Watchers()
    start, _ = load_state(state, rest, watchers, "d")
    rest.require_same(start)
    return run_fit(rest, Budget(), SilentReport(), start=start, watchers=watchers).model.snapshot()


class Stopped(Exception):
    """Raised in the middle of a fit."""


def interrupted(request: Path, world: World, state: Path) -> State:
    """Stopped within a block of steps that share a gradient, and continued."""
    session.SAVE_EVERY = 0.0

    def stop(step: int, loss: object) -> None:
        if step == 6:
            raise Stopped

    def run(look: Any) -> Any:
        fit = make_fit(open_request(request), read_settings({**SHORT, **BLOCKS}), 0, CPU, world)
        every, is_main = fit.shared_steps, world.is_main
        given = fit, Budget(), state, "d", ""
        return run_resumed(*given, is_main=is_main, every=every, look=look)

    with contextlib.suppress(Stopped):
        run(stop)
    world.wait_for_main()
    return run(lambda step, loss: None).model.snapshot()


class NanLoss(Component):
    """A term that is always NaN."""

    def loss(self, *given: Any) -> list[torch.Tensor]:
        return [torch.tensor(math.nan)]


def check_spoiled(request: Path, world: World) -> None:
    """A loss that is NaN in one process only stops the step in all of them."""
    settings = read_settings({**SHORT, **UNJUDGED})
    fit = make_fit(open_request(request), settings, 0, CPU, world)
    before = fit.model.snapshot()
    if world.rank == 1:
        fit.components = [*fit.components, NanLoss()]
    assert math.isnan(fit.step(torch.tensor([0, 1]), 0.0))
    assert all(torch.equal(before[name], v) for name, v in fit.model.snapshot().items())


def meet(rank: int, port: int, work: Callable[[World], int]) -> int:
    """Work as one of two processes; checks that nothing of their meeting remains afterwards."""
    os.environ |= {
        "RANK": str(rank),
        "WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
    }
    groups: list[weakref.ref[Any]] = []

    def watched(world: World) -> int:
        groups.append(weakref.ref(torch.distributed.group.WORLD))
        return work(world)

    try:
        return run_in_world(lambda: CPU, watched)
    finally:
        assert groups[0]() is None, "something holds the group, so that its threads still run"


def process(rank: int, ports: tuple[int, int], folder: Path) -> None:
    """The work of each of two processes; both leave what they found in `folder`."""
    torch.set_num_threads(1)

    def work(world: World) -> int:
        request = folder / "request"
        found = {name: fitted(request, changes, world)[1] for name, changes in VARIANTS.items()}
        found["again"] = fitted(request, VARIANTS["unjudged"], world)[1]
        found["resumed"] = resumed(request, world, folder / "state")
        found["blocks"] = fitted(request, BLOCKS, world)[1]
        found["interrupted"] = interrupted(request, world, folder / "blocks")
        check_spoiled(request, world)
        with pytest.raises(HwpError, match="process 1 of 2 starts from another state"):
            world.require_same(f"{rank:064x}")
        torch.save(found, folder / f"found-{rank}")
        return 0

    def fail(world: World) -> int:
        world.wait_for_main()
        raise UsageError("as asked")

    assert meet(rank, ports[0], work) == 0
    # A thread that hands a tensor back to Python waits until the code here is at its end. If one
    # were alive then, the end of the interpreter would abort this process.
    sys.setswitchinterval(60.0)
    with contextlib.suppress(UsageError):  # of the first to fail
        assert meet(rank, ports[1], fail) == UsageError.exit_status


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def folder(make_painted: Callable[..., Capture], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where two processes left what they found."""
    folder = tmp_path_factory.mktemp("parallel")
    capture = make_painted()
    split = contiguous_split(capture.info.id, FRAMES)
    write_request(folder / "request", capture, split, RunSettings({}, 0, Budget()))
    context = multiprocessing.get_context("spawn")
    ports = (free_port(), free_port())
    processes = [context.Process(target=process, args=(rank, ports, folder)) for rank in (0, 1)]
    for each in processes:
        each.start()
    for each in processes:
        each.join()
    assert [each.exitcode for each in processes] == [0, 0]
    return folder


def found(folder: Path, rank: int = 0) -> dict[str, State]:
    return torch.load(folder / f"found-{rank}", weights_only=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIANTS)
def test_two_processes_fit_as_one_with_the_whole_batch(name: str, folder: Path) -> None:
    """999 of 1000 parameters after 4 steps within 1e-4 of the largest change.

    Sums in another order differ in the last bits, and Adam makes full steps of gradients that
    are nothing but rounding: a few parameters end elsewhere.
    """
    start, alone = fitted(folder / "request", VARIANTS[name], SINGLE_PROCESS)
    together = found(folder)[name]
    change = max(float((alone[key] - start[key]).abs().max()) for key in start)
    apart = torch.cat([(together[key] - alone[key]).abs().flatten() for key in alone])
    assert float((apart > 1e-4 * change).float().mean()) < 1e-3


@pytest.mark.slow
def test_processes_agree_repeat_and_go_on_bit_for_bit(folder: Path) -> None:
    first, second = found(folder), found(folder, 1)
    for name, state in first.items():
        assert all(torch.equal(value, second[name][key]) for key, value in state.items()), name
    for name in ("again", "resumed"):
        assert all(torch.equal(v, first[name][key]) for key, v in first["unjudged"].items()), name
    blocks, again = first["blocks"], first["interrupted"]
    assert all(torch.equal(value, again[key]) for key, value in blocks.items())


def torchrun(arguments: list[str]) -> subprocess.CompletedProcess[str]:
    words = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    # As in a shell of somebody who has not said how threads wait.
    shell = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    said = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "OMP_DISPLAY_ENV": "VERBOSE"}
    return subprocess.run(
        [sys.executable, *words, "-m", "wildghand.cli.main", *arguments],
        capture_output=True,
        text=True,
        env={**shell, **said},
        check=False,
        timeout=600,
    )


@pytest.mark.slow
def test_torchrun_makes_one_avatar_and_one_message(
    make_painted: Callable[..., Capture], tmp_path: Path
) -> None:
    capture, avatar = make_painted().root, tmp_path / "avatar"
    options = [
        word
        for name, value in (SHORT | UNJUDGED).items()
        for word in ("--set", f"{name}={json.dumps(value)}")
    ]
    command = ["fit", str(capture), "-o", str(avatar), "--steps", "2", *options]
    made = torchrun(command)
    assert made.returncode == 0, made.stderr
    assert made.stdout.count("2 steps") == 1
    if "GOMP_SPINCOUNT" in made.stderr:  # GNU's OpenMP tells how often a thread looks again
        assert made.stderr.count("GOMP_SPINCOUNT = '0'") == 2
    assert made.stderr.count("Fitting painted-right") == 1
    assert load_avatar(avatar).steps == 2
    refused = torchrun([*command, "--overwrite", "--set", "schedule.batch=3"])
    assert refused.returncode != 0
    assert refused.stderr.count("wildghand: error: schedule.batch: is 3, which 2 processes") == 1
    assert refused.stderr.count("wildghand: ") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["avatar"]


def test_a_batch_is_split_evenly_or_refused() -> None:
    parts = [World(rank, 3).shard(6) for rank in range(3)]
    assert [list(range(6))[part] for part in parts] == [[0, 1], [2, 3], [4, 5]]
    assert SINGLE_PROCESS.shard(5) == slice(0, 5)
    with pytest.raises(UsageError, match=r"schedule\.batch: is 4, .*schedule\.batch=3"):
        World(0, 3).shard(4)


def test_alone_nothing_is_sent_and_nothing_changed() -> None:
    tensor = torch.ones(3, requires_grad=True)
    (2.0 * tensor).sum().backward()
    before = tensor.grad
    average_gradients([tensor], SINGLE_PROCESS)
    assert tensor.grad is before
    assert SINGLE_PROCESS.gather(tensor) is tensor
    assert SINGLE_PROCESS.average_(tensor) is tensor
    assert SINGLE_PROCESS.broadcast(0.25) == 0.25


@pytest.mark.parametrize(
    ("environment", "device", "message"),
    [
        ({"WORLD_SIZE": "two"}, "cpu", "WORLD_SIZE: is 'two'"),
        ({"WORLD_SIZE": "2"}, "cpu", "processes of the fit cannot meet"),
        ({"WORLD_SIZE": "64", "LOCAL_WORLD_SIZE": "64"}, "cuda", "64 processes .* GPUs"),
    ],
)
def test_processes_that_cannot_meet_are_one_message(
    environment: dict[str, str], device: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(HwpError, match=message) as caught:
        join(torch.device(device))
    assert "\n" not in str(caught.value)


def test_without_torch_distributed_there_is_one_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setattr(torch.distributed, "is_available", lambda: False)
    with pytest.raises(MissingDependency, match=r"lacks torch\.distributed"):
        run_in_world(lambda: CPU, lambda world: 0)
    monkeypatch.setenv("RANK", "1")
    assert run_in_world(lambda: CPU, lambda world: 0) == 1


@pytest.mark.parametrize(("error", "status"), [(UsageError("x"), 2), (KeyboardInterrupt(), 130)])
def test_the_first_to_fail_speaks_and_the_others_are_silent(
    error: BaseException, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = torch.distributed.HashStore()
    monkeypatch.setattr(parallel, "join", lambda device: World(0, 2, "cpu", store))

    def fail(world: World) -> int:
        raise error

    with pytest.raises(type(error)):
        run_in_world(lambda: CPU, fail)
    assert run_in_world(lambda: CPU, fail) == status


def test_one_that_is_stopped_while_it_ends_silently_stays_silent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As `torchrun` does to all others as soon as the first one has ended."""
    store = torch.distributed.HashStore()
    world = World(1, 2, "cpu", store)
    monkeypatch.setattr(parallel, "join", lambda device: world)
    assert world.speaks_first()
    left = []

    def leave() -> None:
        left.append(len(left))
        if len(left) == 1:
            raise KeyboardInterrupt

    def fail(world: World) -> int:
        raise UsageError("x")

    monkeypatch.setattr(parallel, "_leave", leave)
    assert run_in_world(lambda: CPU, fail) == 2
    assert len(left) == 2


def test_an_evaluation_is_one_process_whatever_torchrun_says(
    make_training: TrainingMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "1")
    avatar = WildGHandMethod({**SHORT, "schedule.steps": 1, "schedule.batch": 1}).fit(
        make_training(), Budget(), SilentReport()
    )
    assert avatar.steps == 1
