"""Jobs on a Ray cluster: Ray schedules them and starts them again when a worker is lost."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import threading
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, cast

from hwp_bench.base.console import JobsView
from hwp_bench.base.errors import BadInput, HwpError, MissingDependency, UsageError
from hwp_bench.base.files import cache_root, files_digest, inside, temporary_name
from hwp_bench.base.numerics import flushed
from hwp_bench.base.packages import PACKAGES
from hwp_bench.run.engine.job import (
    Engine,
    Folder,
    Job,
    OnDone,
    OnStart,
    Work,
    raise_first,
)
from hwp_bench.run.engine.processes import (
    LOOK_SECONDS,
    RETRIES,
    VISIBLE_GPUS,
    LocalJob,
    WorkerLost,
    error_record,
    lost_error,
    parse_error,
    run_in_process,
    thread_environment,
)

#: Largest folder that is sent, in bytes of content, and most files and folders in it.
MAX_BYTES, MAX_ENTRIES = 8 << 30, 1_000_000
#: Names that are never sent, at any depth: what Python and git make again.
LEFT_OUT = frozenset({"__pycache__", ".git"})
_EPOCH = (1980, 1, 1, 0, 0, 0)
#: Seconds that the head may take to accept a connection, and to answer as a Ray head.
CONNECT_SECONDS, ANSWER_SECONDS = 10.0, 60.0
#: Port of a Ray head, where none is given.
HEAD_PORT = 6379
_REMEDY = "Give the address that `ray start --head` printed; run the command on a node of it."
_QUIET = {"log_to_driver": False, "logging_level": "error"}
# Ray itself tries for minutes before it gives up; so it is tried in a process that can be ended.
_PROBE = f"import sys, ray\nray.init(address=sys.argv[1], **{_QUIET!r})\n"
#: Packages and folders whose source decides what a job does, and its endings: programs, settings,
#: and the free hand.
SOURCES, SUFFIXES = ("hwp_bench", "wildghand", "baselines"), {".py", ".toml", ".npz"}
#: Seconds that jobs may take to stop when their results are no longer needed.
STOP_SECONDS = 20.0


class RayEngine(Engine):
    """Runs jobs on a Ray cluster; `shared` lets nodes look at the folders of this machine."""

    def __init__(
        self, address: str | None = None, view: JobsView | None = None, *, shared: bool = True
    ) -> None:
        self._address = head_address(address)
        self._view = view or JobsView(quiet=True)
        self._shared = shared
        self._stack = contextlib.ExitStack()
        self._ray: Any = None

    def __enter__(self) -> RayEngine:
        self._ray = self._stack.enter_context(connected(self._address))
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def run(self, jobs: Sequence[Job], on_done: OnDone, on_start: OnStart | None = None) -> None:
        """Run jobs; see `Engine.run`."""
        with self._view as view:
            view.begin(len(jobs))
            _Run(self._ray, view, jobs, on_done, self._shared).all()


class _Run:
    """One call of `RayEngine.run`."""

    def __init__(
        self, ray: Any, view: JobsView, jobs: Sequence[Job], on_done: OnDone, shared: bool
    ) -> None:
        self._ray, self._view, self._jobs, self._on_done = ray, view, jobs, on_done
        self._shared = shared
        self._toolkit = toolkit_digest()
        self._digests: dict[Folder, str] = {}
        self._sent: dict[Folder, Any] = {}
        # Of each job that waits: its index by Ray's reference, the number of its order, its place.
        self._pending: dict[Any, int] = {}
        self._numbers: dict[int, int] = {}
        self._places: dict[int, str] = {}
        self._orders = 0
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        # On the node that orders the jobs, so that no lost node takes the board along.
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
        self._board = ray.remote(Board).options(num_cpus=0, scheduling_strategy=here).remote()
        self._news: Any = self._board.read.remote()

    def all(self) -> None:
        failures: list[HwpError] = []
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
                        failures.append(error)
                        self._view.end(index, self._jobs[index].text, str(error))
        finally:
            self._cancel()
        raise_first(failures, len(self._jobs))

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
            raise lost_error(job.text, type(error).__name__) from error
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
        environment = thread_environment(job.needs)
        if job.needs.gpus == 0:
            environment[VISIBLE_GPUS] = ""
        # Ray starts an order again by itself; a new number is an order that it never had.
        number = self._numbers[index] = self._orders
        self._orders += 1
        order = Order(number, job.work, inputs, environment, self._toolkit)
        task = self._ray.remote(run_order).options(
            name=job.text,
            num_cpus=job.needs.cpus,
            num_gpus=job.needs.gpus,
            max_retries=RETRIES,
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
            self._sent[folder] = self._ray.put(parcel)
        return self._sent[folder]

    def _show(self) -> None:
        # Asked for before, read when it is there: jobs do not wait for the news.
        ready, _ = self._ray.wait([self._news], timeout=0)
        if not ready:
            return
        last: Mapping[int, tuple[str, int, int]] = {}
        with contextlib.suppress(self._ray.exceptions.RayError):
            last = self._ray.get(self._news)
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
        for needs in {self._jobs[index].needs for index in self._pending.values()}:
            if not any(
                node.get("CPU", 0) >= needs.cpus and node.get("GPU", 0) >= needs.gpus
                for node in nodes
            ):
                self._view.say(
                    f"No node has {needs.cpus:g} processors and {needs.gpus:g} GPUs now; jobs "
                    "wait until one joins."
                )

    def _cancel(self) -> None:
        """Stop what still runs, so that no method continues when nobody takes its result."""
        pending = list(self._pending)
        for reference in pending:
            self._ray.cancel(reference)
        if pending:
            self._ray.wait(pending, num_returns=len(pending), timeout=STOP_SECONDS)
        self._ray.kill(self._board)


# --- the connection, or why it fails, in bounded time


def import_ray() -> Any:
    """Import Ray."""
    # No statistics about a run are sent to anybody.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise MissingDependency(
            "Ray is not installed",
            field="--engine",
            remedy="Install it with `pip install 'hwp-bench[ray]'`, or use --engine local.",
        ) from error
    return ray


def head_address(address: str | None) -> str | None:
    """Return HOST:PORT of the head to join; None where a cluster is to be started here."""
    text = os.environ.get("RAY_ADDRESS", "") if address is None else address
    if address is None and text in ("", "auto", "local"):
        return None
    text = text.removeprefix("ray://")
    host, colon, port = text.rpartition(":")
    if not colon:
        host, port = text, str(HEAD_PORT)
    if not host or "/" in host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise UsageError(f"{text!r} is not HOST:PORT", field="--engine", remedy=_REMEDY)
    return f"{host}:{port}"


def check_head(address: str) -> None:
    """Make sure that a Ray head answers."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_SECONDS).close()
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        problem = f"there is no Ray head at {address} ({reason})"
        raise HwpError(problem, field="--engine", remedy=_REMEDY) from error
    command = [sys.executable, "-c", _PROBE, address]
    problem = ""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=ANSWER_SECONDS)
    except subprocess.TimeoutExpired:
        problem = f"{address} does not answer as a Ray head within {ANSWER_SECONDS:g} s"
    else:
        if done.returncode != 0:
            said = [*done.stderr.strip().splitlines(), "it said nothing"][-2:][0]
            problem = f"Ray at {address} refuses: {said[:300]}"
    if problem:
        raise HwpError(problem, field="--engine", remedy=_REMEDY)


@contextlib.contextmanager
def connected(address: str | None) -> Iterator[Any]:
    """Join a cluster, or start one on this machine, and leave it at the end.

    Ray's output is thrown away: standard output is for results.
    """
    ray = import_ray()
    if address is not None:
        check_head(address)
    main = threading.current_thread() is threading.main_thread()
    terminated = signal.getsignal(signal.SIGTERM) if main else None
    where = {"address": address or "local", **_QUIET}
    with contextlib.redirect_stdout(io.StringIO()) as told:
        try:
            ray.init(**where, **({} if address else {"include_dashboard": False}))
        except (ConnectionError, OSError, RuntimeError, ValueError, SystemExit) as error:
            last = told.getvalue().strip().rpartition("\n")[2]
            reason = (str(error) or last or type(error).__name__).splitlines()[0]
            raise HwpError(f"Ray cannot be reached: {reason[:300]}", field="--engine") from error
        if main:
            # Ray puts its own handler, which leaves without stopping the jobs.
            signal.signal(signal.SIGTERM, terminated or signal.SIG_DFL)
        try:
            yield ray
        finally:
            ray.shutdown()


# --- on a node: find the inputs, do the job, send the result


@dataclass(frozen=True)
class Input:
    """A folder that a job reads, by content."""

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
    work: Work
    #: The folders that it reads, by name.
    inputs: Mapping[str, Input]
    environment: Mapping[str, str]
    #: Digest of the toolkit that ordered it.
    toolkit: str


@dataclass(frozen=True)
class Reply:
    """The answer of a node: a result, or the names of missing inputs, or an error."""

    result: Parcel | None = None
    #: Names of inputs that must be sent.
    missing: tuple[str, ...] = ()
    #: Kind, problem, where, field and remedy of an error.
    failure: Mapping[str, str | None] = field(default_factory=dict)


def toolkit_digest() -> str:
    """Return the SHA-256 (hex) of the toolkit's source: what decides results besides inputs."""
    files = (path for package in SOURCES for path in (PACKAGES / package).rglob("*"))
    sources = (path for path in files if path.suffix in SUFFIXES and path.is_file())
    return files_digest(PACKAGES, sources)


@flushed()
def run_order(order: Order, sent: Mapping[str, list[Any]], board: Any) -> Reply:
    """Do a job on this node."""
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
    with tempfile.TemporaryDirectory(prefix="hwp-engine-") as name:
        scratch = Path(name)
        output = scratch / "result"
        job = LocalJob(order.work, inputs, output, order.environment, (scratch,))
        for _ in range(RETRIES + 1):
            with contextlib.suppress(WorkerLost):
                run_in_process(job, tell, lambda: False)
                return pack(output)
    raise HwpError(
        f"the process of a job was killed {RETRIES + 1} times",
        where=socket.gethostname(),
        remedy="Is there enough memory? Ask for more processors with --job-cpus.",
    )


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


# --- folders on the way: one format, one digest, nothing outside the folder


@dataclass(frozen=True)
class Parcel:
    """A packed folder."""

    #: Digest of its content, as `folder_digest` says it.
    digest: str
    data: bytes


class _Sink:
    """Takes an archive that is written to it: its digest, and its bytes where they are kept."""

    def __init__(self, kept: bytearray | None = None) -> None:
        self._hash = hashlib.sha256()
        self._kept = kept

    def write(self, data: bytes) -> int:
        self._hash.update(data)
        if self._kept is not None:
            self._kept += data
        return len(data)

    def flush(self) -> None:
        """Nothing waits."""

    def take(self, root: Path, skip: Sequence[str]) -> str:
        """Take a folder: names, contents, and which files can be executed; returns the digest."""
        with zipfile.ZipFile(cast(BinaryIO, self), "w", zipfile.ZIP_STORED) as archive:
            for name, path in _entries(root, skip):
                if path.is_dir():
                    archive.writestr(zipfile.ZipInfo(f"{name}/", _EPOCH), b"")
                    continue
                info = zipfile.ZipInfo(name, _EPOCH)
                facts = path.stat()
                info.file_size = facts.st_size
                info.external_attr = (0o755 if facts.st_mode & stat.S_IXUSR else 0o644) << 16
                try:
                    with open(path, "rb") as source, archive.open(info, "w") as target:
                        shutil.copyfileobj(source, target)
                except OSError as error:
                    raise BadInput(f"cannot be read ({error.strerror})", where=path) from error
        return self._hash.hexdigest()


def folder_digest(root: Path, skip: Sequence[str] = ()) -> str:
    """Return the SHA-256 (hex) of a folder; `skip` are names directly inside that do not count."""
    return _Sink().take(root, skip)


def pack(root: Path, skip: Sequence[str] = ()) -> Parcel:
    """Pack a folder; the digest is that of the bytes that are sent."""
    data = bytearray()
    digest = _Sink(data).take(root, skip)
    return Parcel(digest, bytes(data))


def unpack(parcel: Parcel, target: Path, *, replace: bool = False) -> None:
    """Unpack a folder under a temporary name, check its digest, and give it its own name."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_name(target)
        temporary.mkdir()
        try:
            _extract(parcel.data, temporary)
            if hashlib.sha256(parcel.data).hexdigest() != parcel.digest:
                raise BadInput("arrived damaged: its digest is different", where=target)
            _swap(temporary, target, replace)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        raise HwpError(
            f"cannot be written ({error.strerror})",
            where=target,
            remedy="Check the free space and the permissions of the folder.",
        ) from error


def _swap(temporary: Path, target: Path, replace: bool) -> None:
    retired = temporary.with_name(f"{temporary.name}.old")
    if replace and target.exists():
        os.replace(target, retired)
    try:
        os.rename(temporary, target)
    except OSError:
        # Another process made the same folder first.
        if replace or not target.is_dir():
            raise
    shutil.rmtree(retired, ignore_errors=True)


def _extract(data: bytes, root: Path) -> None:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            items = archive.infolist()
            if len(items) > MAX_ENTRIES or sum(item.file_size for item in items) > MAX_BYTES:
                raise BadInput("holds more than is taken", where=root)
            for item in items:
                if item.compress_type != zipfile.ZIP_STORED:
                    raise BadInput(f"{item.filename!r} is compressed", where=root)
                path = inside(root, item.filename)
                if item.is_dir():
                    path.mkdir(parents=True, exist_ok=True)
                    continue
                path.parent.mkdir(parents=True, exist_ok=True)
                # Written as plain files whatever the archive calls them, so there are no links.
                with archive.open(item) as source, open(path, "xb") as stream:
                    shutil.copyfileobj(source, stream)
                if item.external_attr >> 16 & 0o100:
                    # Whoever may read it may run it; the rest of the mode is the umask's.
                    mode = path.stat().st_mode
                    path.chmod(mode | (mode & 0o444) >> 2)
    except (zipfile.BadZipFile, FileExistsError, NotADirectoryError, ValueError, EOFError) as error:
        raise BadInput(f"is damaged ({error})", where=root) from error


def _entries(root: Path, skip: Sequence[str]) -> Iterator[tuple[str, Path]]:
    """Yield (name, path) of every folder and file, in one order."""
    if not root.is_dir():
        raise BadInput("is not a folder", where=root)
    found: list[tuple[str, Path]] = []
    size = 0

    def refuse(error: OSError) -> None:
        raise BadInput(f"cannot be read ({error.strerror})", where=error.filename) from error

    for folder, folders, files in os.walk(root, onerror=refuse):
        top = Path(folder) == root
        named = set(skip) if top else set()
        folders[:] = [name for name in folders if name not in LEFT_OUT | named]
        # A file of a name in LEFT_OUT, as `.git` of a submodule, is part of a method's digest.
        for name in (*folders, *(file for file in files if file not in named)):
            path = Path(folder) / name
            facts = path.lstat()
            if not (stat.S_ISREG(facts.st_mode) or stat.S_ISDIR(facts.st_mode)):
                raise BadInput(
                    "is a link or not a plain file, and is not sent to other machines",
                    where=path,
                    remedy="Put a copy of the file in its place.",
                )
            size += facts.st_size if stat.S_ISREG(facts.st_mode) else 0
            found.append((path.relative_to(root).as_posix(), path))
    if len(found) > MAX_ENTRIES or size > MAX_BYTES:
        raise BadInput(
            f"holds {len(found)} files of {size} bytes, more than is sent to other machines",
            where=root,
            remedy=f"At most {MAX_ENTRIES} files of {MAX_BYTES >> 30} GiB.",
        )
    yield from sorted(found)
