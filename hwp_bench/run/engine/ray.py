"""Folders on the way between machines: one format, one digest, nothing outside the folder."""

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
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from hwp_bench.base.console import JobsView
from hwp_bench.base.errors import BadInput, HwpError, MissingDependency, UsageError
from hwp_bench.base.files import cache_root, files_digest, inside, temporary_name
from hwp_bench.base.numerics import flushed
from hwp_bench.base.packages import PACKAGES
from hwp_bench.run.engine.job import (
    RETRIES,
    Failures,
    Folder,
    Job,
    Needs,
    OnDone,
    OnStart,
    Work,
    worker_lost_error,
)
from hwp_bench.run.engine.processes import (
    VISIBLE_GPUS,
    LocalJob,
    WorkerLost,
    error_record,
    parse_error,
    run_in_process,
    thread_environment,
)

#: Largest folder that is sent, in bytes of content.
MAX_BYTES = 8 << 30
#: Most files and folders in it.
MAX_ENTRIES = 1_000_000
#: Names that are never sent, at any depth: what Python and git make again.
LEFT_OUT = frozenset({"__pycache__", ".git"})

_EPOCH = (1980, 1, 1, 0, 0, 0)
_CHUNK = 1 << 20


@dataclass(frozen=True)
class Parcel:
    """A packed folder."""

    #: Digest of its content, as `folder_digest` says it.
    digest: str
    #: The bytes.
    data: bytes


def folder_digest(root: Path, skip: Sequence[str] = ()) -> str:
    """Return the SHA-256 (hex) of a folder: names, content, and which files can be executed.

    `skip` are names directly inside it that do not count.
    """
    return _pack(root, skip, None)


def pack(root: Path, skip: Sequence[str] = ()) -> Parcel:
    """Pack a folder; the digest is that of the bytes that are sent."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        digest = _pack(root, skip, archive)
    return Parcel(digest, buffer.getvalue())


def _pack(root: Path, skip: Sequence[str], archive: zipfile.ZipFile | None) -> str:
    """Read a folder in one order, into an archive if there is one; returns its digest."""
    total = hashlib.sha256()
    for name, path in _entries(root, skip):
        if path.is_dir():
            total.update(f"d\0{name}\0".encode())
            if archive is not None:
                archive.writestr(zipfile.ZipInfo(f"{name}/", _EPOCH), b"")
            continue
        executable = path.stat().st_mode & stat.S_IXUSR
        try:
            with open(path, "rb") as stream:
                content = None if archive is None else stream.read()
                digest = (
                    hashlib.file_digest(stream, "sha256")
                    if content is None
                    else hashlib.sha256(content)
                )
        except OSError as error:
            raise BadInput(f"cannot be read ({error.strerror})", where=path) from error
        total.update(f"{'x' if executable else 'f'}\0{name}\0".encode() + digest.digest())
        if archive is not None and content is not None:
            info = zipfile.ZipInfo(name, _EPOCH)
            info.external_attr = (0o755 if executable else 0o644) << 16
            archive.writestr(info, content)
    return total.hexdigest()


def unpack(parcel: Parcel, target: Path, *, replace: bool = False) -> None:
    """Unpack a folder under a temporary name, check its digest, and give it its own name."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_name(target)
        temporary.mkdir()
        try:
            _extract(parcel.data, temporary)
            if folder_digest(temporary) != parcel.digest:
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
                    shutil.copyfileobj(source, stream, _CHUNK)
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
    for folder, folders, files in os.walk(root, onerror=_refuse):
        top = Path(folder) == root
        left_out = LEFT_OUT | set(skip) if top else LEFT_OUT
        folders[:] = [name for name in folders if name not in left_out]
        for name in (*folders, *(file for file in files if file not in left_out)):
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


def _refuse(error: OSError) -> None:
    raise BadInput(f"cannot be read ({error.strerror})", where=error.filename) from error


#: Seconds that the head may take to accept a connection.
CONNECT_SECONDS = 10.0
#: Seconds that it may take to answer as a Ray head of this version.
ANSWER_SECONDS = 60.0
#: Port of a Ray head, where none is given.
HEAD_PORT = 6379

_REMEDY = "Give the address that `ray start --head` printed; run the command on a node of it."
# Ray itself tries for minutes before it gives up; so it is tried in a process that can be ended.
_PROBE = (
    "import sys, ray\nray.init(address=sys.argv[1], log_to_driver=False, logging_level='error')\n"
)


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
        raise HwpError(
            f"there is no Ray head at {address} ({reason})", field="--engine", remedy=_REMEDY
        ) from error
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE, address],
            capture_output=True,
            text=True,
            timeout=ANSWER_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise HwpError(
            f"{address} does not answer as a Ray head within {ANSWER_SECONDS:g} s",
            field="--engine",
            remedy=_REMEDY,
        ) from error
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines()
        raise HwpError(
            f"Ray at {address} refuses: {lines[-1][:300] if lines else 'it said nothing'}",
            field="--engine",
            remedy=_REMEDY,
        )


@contextlib.contextmanager
def connected(address: str | None) -> Iterator[Any]:
    """Join a cluster, or start one on this machine; left again at the end.

    Ray's output is thrown away: standard output is for results.
    """
    ray = import_ray()
    if address is not None:
        check_head(address)
    main = threading.current_thread() is threading.main_thread()
    terminated = signal.getsignal(signal.SIGTERM) if main else None
    quiet = {"log_to_driver": False, "logging_level": "error"}
    with contextlib.redirect_stdout(_Tail()) as tail:
        try:
            if address is not None:
                ray.init(address=address, **quiet)
            else:
                ray.init(address="local", include_dashboard=False, **quiet)
        except (ConnectionError, OSError, RuntimeError, ValueError, SystemExit) as error:
            reason = (str(error) or tail.last or type(error).__name__).splitlines()[0]
            raise HwpError(f"Ray cannot be reached: {reason[:300]}", field="--engine") from error
        if main:
            # Ray puts its own handler, which leaves without stopping the jobs.
            signal.signal(signal.SIGTERM, terminated or signal.SIG_DFL)
        try:
            yield ray
        finally:
            ray.shutdown()


class _Tail(io.TextIOBase):
    """A stream that keeps its last lines."""

    def __init__(self) -> None:
        self._lines: deque[str] = deque(maxlen=20)

    def write(self, text: str) -> int:
        self._lines.extend(text.splitlines())
        return len(text)

    @property
    def last(self) -> str:
        return self._lines[-1] if self._lines else ""


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


#: Seconds between two checks of the jobs.
LOOK_SECONDS = 0.5
#: Seconds that jobs may take to stop when their results are no longer needed.
STOP_SECONDS = 20.0


class RayEngine:
    """Runs jobs on a Ray cluster."""

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
            raise worker_lost_error(job.text, self._retries, type(error).__name__) from error
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

        # On the node that orders the jobs, so that no worker_lost_error node takes it along.
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
