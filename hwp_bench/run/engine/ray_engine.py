"""Jobs on a Ray cluster: Ray schedules them and starts them again when a worker is lost."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any

from hwp_bench.base.console import JobsView
from hwp_bench.base.errors import HwpError
from hwp_bench.run.engine.job import (
    RETRIES,
    Failures,
    Folder,
    Job,
    Needs,
    OnDone,
    OnStart,
    lost,
)
from hwp_bench.run.engine.parcel import folder_digest, pack, unpack
from hwp_bench.run.engine.process import parse_error, thread_environment
from hwp_bench.run.engine.ray_connect import connected, head_address
from hwp_bench.run.engine.ray_task import Board, Input, Order, Reply, run_order, toolkit_digest

#: Seconds between two checks of the jobs.
LOOK_SECONDS = 0.5
#: Seconds that jobs may take to stop when their results are no longer needed.
STOP_SECONDS = 20.0


class RayEngine:
    """Runs jobs on a Ray cluster.

    Args:
        address: HOST:PORT of the head; None takes RAY_ADDRESS, else starts a cluster
            of this machine.
        view: shows the jobs; nothing if None.
        shared: whether nodes may look for inputs at their place here, and take them if the
            content is the same. Inputs that are not found are sent.
        retries: times that a job is started again after its worker or node was lost.

    Raises:
        UsageError: the address is not HOST:PORT.
        MissingDependency: on entering, Ray is not installed.
        HwpError: on entering, there is no such cluster.
    """

    in_turn = False

    def __init__(
        self,
        address: str | None = None,
        view: JobsView | None = None,
        *,
        shared: bool = True,
        retries: int = RETRIES,
    ) -> None:
        self._address = head_address(address)
        self._view = view or JobsView(quiet=True)
        self._shared = shared
        self._retries = retries
        self._stack = contextlib.ExitStack()
        self._ray: Any = None

    def __enter__(self) -> RayEngine:
        self._ray = self._stack.enter_context(connected(self._address))
        return self

    def __exit__(self, *error: object) -> None:
        self._ray = None
        self._stack.close()

    def run(self, jobs: Sequence[Job], on_done: OnDone, on_start: OnStart | None = None) -> None:
        """Run jobs; see `Engine.run`."""
        with self._view as view:
            view.begin(len(jobs))
            _Run(self._ray, view, jobs, on_done, self._shared, self._retries).all()


class _Run:
    """One call of `RayEngine.run`."""

    def __init__(
        self,
        ray: Any,
        view: JobsView,
        jobs: Sequence[Job],
        on_done: OnDone,
        shared: bool,
        retries: int,
    ) -> None:
        self._ray = ray
        self._view = view
        self._jobs = jobs
        self._on_done = on_done
        self._shared = shared
        self._retries = retries
        self._toolkit = toolkit_digest()
        self._digests: dict[Folder, str] = {}
        self._sent: dict[Folder, tuple[str, Any]] = {}
        self._pending: dict[Any, int] = {}
        self._orders = 0
        self._numbers: dict[int, int] = {}
        self._places: dict[int, str] = {}
        self._board = self._start_board()
        self._news: Any = None

    def all(self) -> None:
        failures = Failures()
        try:
            for index, job in enumerate(self._jobs):
                if job.finished():
                    self._end(index)
                else:
                    self._submit(index, ())
            self._say_if_none_fits()
            while self._pending:
                ready, _ = self._ray.wait(list(self._pending), timeout=LOOK_SECONDS)
                self._show()
                for reference in ready:
                    index = self._pending.pop(reference)
                    try:
                        self._take(index, reference)
                    except HwpError as error:
                        failures.add(error)
                        self._view.end(index, self._jobs[index].text, str(error))
        finally:
            self._cancel()
        failures.raise_first(len(self._jobs))

    def _take(self, index: int, reference: Any) -> None:
        job = self._jobs[index]
        try:
            reply: Reply = self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:
            reason = str(error).strip().splitlines()[-1][:300]
            raise HwpError(
                f"the job {job.text!r} could not run on its node: {reason}",
                remedy="Install the same version of the toolkit on every node.",
            ) from error
        except self._ray.exceptions.RayError as error:
            raise lost(job.text, self._retries, type(error).__name__) from error
        if reply.missing:
            self._places.pop(index, None)
            self._view.drop(index)
            self._submit(index, reply.missing)
        elif reply.result is None:
            raise parse_error(reply.failure)
        else:
            unpack(reply.result, job.output, replace=True)
            self._end(index)

    def _end(self, index: int) -> None:
        self._view.end(index, self._jobs[index].text)
        self._on_done(index)

    def _submit(self, index: int, send: Sequence[str]) -> None:
        """Hand a job to Ray, with the inputs that its node did not have."""
        job = self._jobs[index]
        sent = {name: [self._parcel(job.inputs[name])] for name in send}
        inputs = {
            name: Input(
                self._digest(folder),
                str(folder.path.absolute()) if self._shared else None,
                folder.skip,
            )
            for name, folder in job.inputs.items()
        }
        # Ray starts an order again by itself; a new number is an order that it never had.
        number = self._orders
        self._orders += 1
        self._numbers[index] = number
        order = Order(
            number,
            job.work,
            inputs,
            thread_environment(job.needs),
            job.needs.gpus > 0,
            self._toolkit,
        )
        task = self._ray.remote(run_order).options(
            name=job.text,
            num_cpus=job.needs.cpus,
            num_gpus=job.needs.gpus,
            max_retries=self._retries,
        )
        self._pending[task.remote(order, sent, self._board)] = index

    def _digest(self, folder: Folder) -> str:
        if folder not in self._digests:
            self._digests[folder] = folder_digest(folder.path, folder.skip)
        return self._digests[folder]

    def _parcel(self, folder: Folder) -> Any:
        """Put a folder into Ray's store, once; from then on its digest is that of what was put."""
        if folder not in self._sent:
            parcel = pack(folder.path, folder.skip)
            self._digests[folder] = parcel.digest
            self._sent[folder] = parcel.digest, self._ray.put(parcel)
        return self._sent[folder][1]

    def _start_board(self) -> Any:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        # On the node that orders the jobs, so that no lost node takes it along.
        here = self._ray.get_runtime_context().get_node_id()
        place = NodeAffinitySchedulingStrategy(here, soft=True)
        return self._ray.remote(Board).options(num_cpus=0, scheduling_strategy=place).remote()

    def _show(self) -> None:
        # Asked for now, read when it is there: jobs do not wait for the news.
        if self._news is None:
            self._news = self._board.read.remote()
        ready, _ = self._ray.wait([self._news], timeout=0)
        if not ready:
            return
        try:
            last: Mapping[int, tuple[str, int, int]] = self._ray.get(self._news)
        except self._ray.exceptions.RayError:
            last = {}
        self._news = self._board.read.remote()
        for index in self._pending.values():
            place, done, total = last.get(self._numbers[index], ("", 0, 0))
            if place and self._places.get(index) != place:
                self._places[index] = place
                self._view.start(index, self._jobs[index].text, place)
            if total:
                self._view.steps(index, done, total)

    def _say_if_none_fits(self) -> None:
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        waiting = {self._jobs[index].needs for index in self._pending.values()}
        for needs in waiting:
            if not any(_fits(needs, resources) for resources in nodes):
                self._view.say(
                    f"No node has {needs.cpus:g} processors and {needs.gpus:g} GPUs now; jobs "
                    "wait until one joins."
                )

    def _cancel(self) -> None:
        """Stop what still runs, so that no method goes on when nobody takes its result."""
        pending = list(self._pending)
        for reference in pending:
            self._ray.cancel(reference)
        if pending:
            self._ray.wait(pending, num_returns=len(pending), timeout=STOP_SECONDS)
        self._ray.kill(self._board)


def _fits(needs: Needs, resources: Mapping[str, float]) -> bool:
    return resources.get("CPU", 0) >= needs.cpus and resources.get("GPU", 0) >= needs.gpus
