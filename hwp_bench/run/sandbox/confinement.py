"""How far a method's process is confined, and what it finds: environment variables and files.

The list of what is shown is fixed: another interpreter, for example, is shown only where a person
names it (`--expose`).
"""

from __future__ import annotations

import contextlib
import os
import site
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from glob import escape, glob
from pathlib import Path

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import cache_root
from hwp_bench.base.numerics import OPENCV_WAITING, OPENMP_WAITING, TORCH_COUNTS
from hwp_bench.base.packages import PACKAGES
from hwp_bench.methods.contents import LEFT_OUT, unseen_folders
from hwp_bench.methods.manifest import ships
from hwp_bench.metrics.lpips import torch_home
from hwp_bench.run.sandbox.launch import Place
from hwp_bench.run.sandbox.supervise import SCRATCH, SCRATCH_BYTES, default_limit, scratch_bytes

#: Files that a project has at its top, next to what nobody needs who imports it.
_PROJECT_MARKS = ("pyproject.toml", "setup.py", "setup.cfg", ".git")
#: Parts of `hwp_bench` that a method may import: all that methods which ship are built from. Any
#: other stays out of sight; those render, seal, score or rank test frames.
VISIBLE_PACKAGES = frozenset(
    {"_data", "analysis", "base", "capture", "cli", "hands", "importers", "methods", "metrics"}
    | {"report", "results", "run", "tracking"}
)
#: `auto` takes namespaces where the system allows them and says so where it does not; `required`
#: refuses to run without; `none` leaves the program its user's files and network.
MODES = ("auto", "required", "none")
#: Environment variables that a method's process inherits in any case.
INHERITED = (
    *("CUDA_VISIBLE_DEVICES", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "PATH", "PYTHONPATH"),
    *("VIRTUAL_ENV", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "GOTO_NUM_THREADS"),
    *OPENMP_WAITING,
    *OPENCV_WAITING,
    *TORCH_COUNTS,
)
#: Variables that name folders, which exist only where it runs without a sandbox.
INHERITED_FOLDERS = ("HOME", "TMPDIR", "TORCH_HOME", "XDG_CACHE_HOME")
# Programs and libraries. /usr/local and CUDA's usual places are inside.
_SYSTEM = ("usr", "bin", "sbin", "lib", "lib32", "lib64", "libx32", "opt", "nix/store", "gnu/store")
# Of /etc only what programs look up; not, for example, /etc/shadow.
_ETC = (
    *("OpenCL", "alternatives", "fonts", "group", "hosts", "ld.so.cache", "ld.so.conf"),
    *("ld.so.conf.d", "localtime", "nsswitch.conf", "passwd"),
)
# Of /sys what tells processors, memory and accelerators; not firmware, nor the kernel's tracing.
_SYS = ("bus", "class", "dev", "devices", "fs/cgroup", "kernel/mm", "module")
_DEVICES = ("null", "zero", "full", "random", "urandom")
_ACCELERATORS = ("nvidia*", "dri", "kfd")
# What the sandbox shows in part must not be opened whole by a word on the command line.
_NEVER_EXPOSED = ("/", "/dev", "/dev/shm")
_NEVER_FROM = ("/proc", "/sys")
_MOST_LINKS = 40
#: Folders inside the output of a run: its cache, and its home inside the sandbox.
CACHE, HOME = "cache", "home"
#: As `hwp_bench.base.kernels.KEPT`, which needs numba.
KEPT_KERNELS = "HWP_KEPT_KERNELS"


@dataclass(frozen=True)
class Confinement:
    """Limits of a method's process, besides its time limit."""

    #: One of `MODES`.
    mode: str = "auto"
    #: Most memory of all its processes together, bytes; None: nine tenths of what is free when it
    #: starts.
    memory_limit: int | None = None
    #: Files and folders that it may read besides the system, Python, the toolkit, its own folder
    #: and its request, such as weights.
    exposed: tuple[Path, ...] = ()
    #: Folders that stay empty for it even inside a folder that it may read.
    hidden: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise UsageError(f"{self.mode!r} is not one of {', '.join(MODES)}", field="isolation")
        if self.memory_limit is not None and self.memory_limit <= 0:
            raise UsageError(f"{self.memory_limit} is not above 0", field="memory limit")
        for path in self.exposed:
            if _opens_the_machine(path):
                raise UsageError(
                    "would open the whole machine to a method",
                    where=path,
                    field="--expose",
                    remedy="Name the files or folders that it needs, one by one.",
                )

    @property
    def memory_bytes(self) -> int:
        """The limit in force for a program that starts now, bytes."""
        return default_limit() if self.memory_limit is None else self.memory_limit


def plain_environment(method: Path, output: Path) -> dict[str, str]:
    """Return the environment of a method that runs without a sandbox."""
    return {**_taken((*INHERITED, *INHERITED_FOLDERS)), **_cache_environment(method, output)}


def sandbox_environment(
    method: Path, request: Path, output: Path, confinement: Confinement
) -> tuple[dict[str, str], list[Place]]:
    """Return the environment of a method in a sandbox, and what it sees of the file system.

    It may write to its output folder, which holds a cache and a home that are empty when it begins
    and removed when it has ended: nothing that a method wrote reaches another run. It may read the
    machine code that the toolkit has compiled. It does not see the simulator, nor captures and
    runs that lie below its own folder, unless `exposed` names them.

    Nothing that a method brings decides what is shown: not its command, nor links in its folder.
    """
    for path in confinement.exposed:
        if not path.exists():
            raise UsageError("does not exist", where=path, field="--expose")
    home = output / HOME
    home.mkdir(exist_ok=True)
    environment = {
        **_taken(INHERITED),
        "HOME": str(home.resolve()),
        **_cache_environment(method, output),
    }
    weights = torch_home()
    if weights.is_dir():
        environment["TORCH_HOME"] = str(weights)
    shown = {os.path.realpath(path) for path in confinement.exposed}
    unseen = unseen_folders(method.resolve(), ships=ships(method))
    # A person may show a capture or a run, but not what is in no digest.
    unseen = [path for path in unseen if path.name in LEFT_OUT or os.fspath(path) not in shown]
    kernels = _kernels()
    cache = [] if os.path.realpath(cache_root()) in shown else [cache_root().absolute()]
    places = visible_places(
        read=[method, request, weights, kernels, *_libraries(), *confinement.exposed],
        write=[output, kernels] if KEPT_KERNELS in environment else [output],
        hidden=[*unseen, *cache, *confinement.hidden],
        scratch=scratch_bytes(confinement.memory_bytes),
    )
    return environment, places


def has_accelerators() -> bool:
    """Whether the machine has devices whose drivers run in the method's process."""
    return any(glob(f"/dev/{name}") for name in _ACCELERATORS)


def hand_model_files(source: str) -> list[Path]:
    """Return the files of a hand model that a user brought, to be shown to a method."""
    kind, _, place = source.partition(":")
    path = Path(place)
    if not kind.startswith("mano") or not path.is_absolute():
        return []
    # Named one by one: a capture must not choose a folder that is then shown whole.
    folders = (path.parent,) if path.is_file() else (path, path / "models")
    names = (path.name, "MANO_RIGHT.pkl", "MANO_LEFT.pkl")
    files = [folder / name for folder in folders for name in names if name.endswith(".pkl")]
    return [file for file in files if file.is_file()]


def _opens_the_machine(path: Path) -> bool:
    absolute = os.path.abspath(path)
    # Links of the process table cannot be followed for everybody; they are refused before.
    real = os.path.realpath(absolute) if not _of_the_kernel(absolute) else absolute
    return real in _NEVER_EXPOSED or _of_the_kernel(real)


def _of_the_kernel(path: str) -> bool:
    return any(Path(path).is_relative_to(top) for top in _NEVER_FROM)


def _taken(names: Sequence[str]) -> dict[str, str]:
    return {name: os.environ[name] for name in names if name in os.environ}


def _libraries() -> list[Path]:
    """Folders of `PYTHONPATH`."""
    entries = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    absolute = [entry for entry in entries if os.path.isabs(entry)]
    return [Path(path) for entry in absolute for path in package_paths(entry)]


def _cache_environment(method: Path, output: Path) -> dict[str, str]:
    """Variables of the caches: a new one for this run, and the machine code of the toolkit.

    A method that ships is the toolkit's own code and compiles for all; another one only reads.
    """
    cache = output.resolve() / CACHE
    cache.mkdir(mode=0o700, exist_ok=True)
    environment = {
        "HWP_CACHE": str(cache),
        "NUMBA_CACHE_DIR": str(cache / "numba"),
        "HWP_KERNELS": str(_kernels()),
    }
    if ships(method):
        with contextlib.suppress(OSError):
            _kernels().mkdir(mode=0o700, parents=True, exist_ok=True)
            environment[KEPT_KERNELS] = str(_kernels())
    return environment


def _kernels() -> Path:
    return cache_root().absolute() / "kernels"


# --- the file system


def visible_places(
    *,
    read: Iterable[Path],
    write: Iterable[Path],
    hidden: Iterable[Path] = (),
    scratch: int = SCRATCH_BYTES,
) -> list[Place]:
    """Return the places that a sandbox shows, outer ones first."""
    chosen: dict[str, tuple[str, str]] = {
        "/proc": ("proc", ""),
        "/dev/fd": ("link", "/proc/self/fd"),
        "/dev/stdin": ("link", "/proc/self/fd/0"),
        "/dev/stdout": ("link", "/proc/self/fd/1"),
        "/dev/stderr": ("link", "/proc/self/fd/2"),
    }
    chosen |= dict.fromkeys(SCRATCH, ("scratch", str(scratch)))
    shown = [*_system(), *python_places(), *map(os.fspath, read)]
    rooms = hidden_packages([*shown, "/usr/local", *glob("/opt/*")])
    groups: Sequence[tuple[str, Iterable[str | Path]]] = (
        ("read", shown),
        ("hidden", [*toolkit_checkout(), *rooms, *hidden]),
        ("write", write),
    )
    for kind, paths in groups:
        for path in paths:
            links, real = _resolved(os.path.abspath(path))
            if os.path.exists(real) and real != "/":
                chosen |= {place: ("link", target) for place, target in links}
                chosen[real] = (kind, "")
    # An outer place must be there before what lies in it; links are never inside themselves.
    order = sorted(chosen, key=lambda path: (path.count("/"), path))
    return [(chosen[path][0], path, chosen[path][1]) for path in order]


def _system() -> list[str]:
    names = (*_DEVICES, *_ACCELERATORS)
    devices = [path for name in names for path in glob(f"/dev/{name}")]
    named = {"/": _SYSTEM, "/etc/": _ETC, "/sys/": _SYS}
    return [f"{top}{name}" for top, below in named.items() for name in below] + devices


def _resolved(path: str) -> tuple[list[tuple[str, str]], str]:
    """Return the symbolic links on the way to a path, and the real path."""
    links: list[tuple[str, str]] = []
    current, pending = "/", [part for part in path.split("/") if part]
    while pending:
        part = pending.pop(0)
        if part in (".", ".."):
            current = os.path.dirname(current) if part == ".." else current
            continue
        candidate = os.path.join(current, part)
        if os.path.islink(candidate) and len(links) < _MOST_LINKS:
            target = os.readlink(candidate)
            links.append((candidate, target))
            pending = [step for step in target.split("/") if step] + pending
            current = "/" if target.startswith("/") else current
        else:
            current = candidate
    return links, current


# --- the interpreter, its packages, the toolkit


def python_places() -> list[str]:
    """Return the folders of this interpreter, its packages and the toolkit."""
    sites = [*site.getsitepackages(), site.getusersitepackages()]
    # The folders that `.pth` files add, as editable installs do.
    files = [Path(path) for folder in sites for path in glob(f"{folder}/*.pth")]
    lines = [line for file in files for line in file.read_text(errors="replace").splitlines()]
    folders = [line.strip() for line in lines if os.path.isabs(line)]
    linked = [path for one in folders if os.path.isdir(one) for path in package_paths(one)]
    return [sys.prefix, sys.base_prefix, *package_paths(os.fspath(PACKAGES)), *sites, *linked]


def package_paths(folder: str) -> list[str]:
    """Return what is shown of a folder on the path: of a project, its packages and modules.

    Methods need nothing else of it, such as tests, runs, history and files with secrets.
    """
    real = os.path.realpath(folder)
    if not any(os.path.exists(os.path.join(real, mark)) for mark in _PROJECT_MARKS):
        return [folder]
    packages = [os.path.dirname(path) for path in glob(f"{escape(real)}/*/__init__.py")]
    modules = [path for end in ("py", "so") for path in glob(f"{escape(real)}/*.{end}")]
    return packages if _is_checkout(real) else [*packages, *modules]


def toolkit_checkout() -> list[str]:
    """Return the toolkit's checkout, to be hidden where it lies in a folder that is shown."""
    root = os.path.realpath(PACKAGES)
    return [root] if _is_checkout(root) else []


def _is_checkout(folder: str) -> bool:
    files = ("hwp_bench/__init__.py", "pyproject.toml")
    return all(os.path.isfile(os.path.join(folder, file)) for file in files)


# --- what stays out of sight although it lies in a folder that is shown


def hidden_packages(folders: Iterable[str]) -> list[str]:
    """Return the parts of every installed `hwp_bench` that methods do not see.

    The simulator, the scenes and the seeds of the suites are public, so a method that could import
    them would render the test frames again.
    """
    found = []
    for folder in folders:
        inside = glob(f"{escape(folder)}/lib*/python*/*-packages")
        for place in (folder, os.path.dirname(folder), *inside):
            package = os.path.join(place, "hwp_bench")
            # A name alone would hide somebody else's folder of that name.
            if os.path.isfile(os.path.join(package, "__init__.py")):
                found += _parts(package)
    return list(dict.fromkeys(found))


def _parts(package: str) -> list[str]:
    with os.scandir(package) as entries:
        return [
            entry.path
            for entry in entries
            # A link would have another place hidden.
            if entry.is_dir(follow_symlinks=False)
            and entry.name not in VISIBLE_PACKAGES | {"__pycache__"}
        ]
