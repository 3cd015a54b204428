"""How far a method's process is confined, and what it finds: environment variables and files."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from glob import glob
from pathlib import Path

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import cache_root
from hwp_bench.base.packages import PACKAGES, data_folder
from hwp_bench.base.threads import OPENCV_WAITING, OPENMP_WAITING, TORCH_COUNTS
from hwp_bench.run.sandbox.pythons import checkout, environment_of, of_packages, python_places
from hwp_bench.run.sandbox.root import Place
from hwp_bench.run.sandbox.secluded import foreign_folders, secluded_rooms

#: `auto` takes namespaces where the system allows them and says so where it does not; `required`
#: refuses to run without; `none` leaves the program its user's files and network.
MODES = ("auto", "required", "none")
#: Share of the machine's memory that a program may take unless told otherwise.
DEFAULT_MEMORY_SHARE = 0.9

#: Environment variables that a method's process inherits in any case.
INHERITED = (
    "CUDA_VISIBLE_DEVICES",
    "LANG",
    "LC_ALL",
    "LD_LIBRARY_PATH",
    "NUMBA_NUM_THREADS",
    *OPENMP_WAITING,
    *OPENCV_WAITING,
    *TORCH_COUNTS,
    "OPENBLAS_NUM_THREADS",
    "GOTO_NUM_THREADS",
    "PATH",
    "PYTHONPATH",
    "VIRTUAL_ENV",
)
#: Variables that name folders, which exist only where it runs without a sandbox.
INHERITED_FOLDERS = (
    "HOME",
    "HWP_CACHE",
    "NUMBA_CACHE_DIR",
    "TMPDIR",
    "TORCH_HOME",
    "XDG_CACHE_HOME",
)

# Programs and libraries. /usr/local and CUDA's usual places are inside.
_SYSTEM = ("usr", "bin", "sbin", "lib", "lib32", "lib64", "libx32", "opt", "nix/store", "gnu/store")
# Of /etc only what programs look up; not, for example, /etc/shadow.
_ETC = (
    "OpenCL",
    "alternatives",
    "fonts",
    "group",
    "hosts",
    "ld.so.cache",
    "ld.so.conf",
    "ld.so.conf.d",
    "localtime",
    "nsswitch.conf",
    "passwd",
)
# Of /sys what tells processors, memory and accelerators; not firmware, nor the kernel's tracing.
_SYS = ("bus", "class", "dev", "devices", "fs/cgroup", "kernel/mm", "module")
_DEVICES = ("null", "zero", "full", "random", "urandom", "nvidia*", "dri", "kfd")
_SCRATCH = ("/tmp", "/var/tmp", "/dev/shm")
_MOST_LINKS = 40


@dataclass(frozen=True)
class Confinement:
    """Limits of a method's process, besides its time limit."""

    #: One of `MODES`.
    mode: str = "auto"
    #: Most memory of all its processes together, bytes; None: nine tenths of the machine's.
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

    @property
    def memory_bytes(self) -> int:
        """The limit in force, bytes."""
        if self.memory_limit is not None:
            return self.memory_limit
        import psutil

        return int(DEFAULT_MEMORY_SHARE * psutil.virtual_memory().total)


def plain_environment() -> dict[str, str]:
    """Return the environment of a method that runs without a sandbox."""
    return _taken((*INHERITED, *INHERITED_FOLDERS))


def sandbox_environment(
    method: Path,
    command: Sequence[str],
    request: Path,
    output: Path,
    confinement: Confinement,
) -> tuple[dict[str, str], list[Place]]:
    """Return the environment of a method in a sandbox, and what it sees of the file system.

    It may write to its output folder, and to a cache that it shares only with other runs of the
    same method: compiled code must survive a run, and must never reach another program. It may
    read the machine code that the toolkit itself has compiled. It does not see the simulator, nor
    captures and runs that lie below its own folder (`secluded`), unless `exposed` names them.

    Args:
        method: its directory.
        command: its words; the first is the program.
        request: the folder that it is given.
        output: its work folder.
        confinement: what else is shown or hidden.

    Raises:
        UsageError: a path that is to be exposed does not exist.
    """
    for path in confinement.exposed:
        if not path.exists():
            raise UsageError("does not exist", where=path, field="--expose")
    home = output / "home"
    home.mkdir()
    cache = _own_cache(method, output)
    kernels = cache_root().absolute() / "kernels"
    environment = {
        **_taken(INHERITED),
        "HOME": str(home.resolve()),
        "HWP_CACHE": str(cache),
        "NUMBA_CACHE_DIR": str(cache / "numba"),
        "HWP_KERNELS": str(kernels),
    }
    weights = _torch_home()
    if weights.is_dir():
        environment["TORCH_HOME"] = str(weights)
    shown = {os.path.realpath(path) for path in confinement.exposed}
    foreign = [path for path in foreign_folders(method.resolve()) if path not in shown]
    places = visible_places(
        read=[method, request, weights, kernels, *_libraries(), *confinement.exposed],
        write=[output, cache],
        hidden=[*map(Path, foreign), *_unless(shown, cache_root()), *confinement.hidden],
        program=command[0],
    )
    return environment, places


def hand_model_files(source: str) -> list[Path]:
    """Return the files of a hand model that a user brought, to be shown to a method.

    Args:
        source: the model as a capture names it: `anny`, `mano:PATH`, `mano-hd:PATH`.
    """
    kind, _, place = source.partition(":")
    path = Path(place)
    if not kind.startswith("mano") or not path.is_absolute():
        return []
    # Named one by one: a capture must not choose a folder that is then shown whole.
    folders = (path.parent,) if path.is_file() else (path, path / "models")
    names = (path.name, "MANO_RIGHT.pkl", "MANO_LEFT.pkl")
    files = [folder / name for folder in folders for name in names if name.endswith(".pkl")]
    return [file for file in files if file.is_file()]


def _taken(names: Sequence[str]) -> dict[str, str]:
    return {name: os.environ[name] for name in names if name in os.environ}


def _unless(shown: set[str], folder: Path) -> list[Path]:
    return [] if os.path.realpath(folder) in shown else [folder.absolute()]


def _libraries() -> list[Path]:
    """Folders of `PYTHONPATH`."""
    entries = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    absolute = [entry for entry in entries if os.path.isabs(entry)]
    return [Path(path) for entry in absolute for path in of_packages(entry)]


def _torch_home() -> Path:
    """Folder of torch's downloaded weights, which methods may read but not write."""
    cache = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    return Path(os.environ.get("TORCH_HOME") or f"{cache}/torch").expanduser()


def _own_cache(method: Path, output: Path) -> Path:
    name = hashlib.sha256(os.fsencode(_identity(method.resolve()))).hexdigest()[:16]
    cache = cache_root().absolute() / "methods" / name
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:
        cache = output.resolve() / "cache"
        cache.mkdir()
    return cache.resolve()


def _identity(method: Path) -> str:
    """Return what makes a method the same program as another time: its place, as a rule.

    A method that ships has its name: its machine code is then found after another installation.
    """
    for folder in (data_folder("baselines"), PACKAGES / "wildghand"):
        if method.is_relative_to(folder):
            return f"{folder.name}/{method.relative_to(folder)}"
    return os.fspath(method)


def visible_places(
    *,
    read: Iterable[Path],
    write: Iterable[Path],
    hidden: Iterable[Path] = (),
    program: str | None = None,
) -> list[Place]:
    """Return the places that a sandbox shows, outer ones first.

    Args:
        read: files and folders that it may read, besides the system, Python and the toolkit.
        write: folders that it may write to.
        hidden: folders that stay empty even inside a folder that it may read.
        program: the program that is started; a Python environment that it lies in is shown.
    """
    chosen: dict[str, tuple[str, str]] = {
        "/proc": ("proc", ""),
        "/dev/fd": ("link", "/proc/self/fd"),
    }
    chosen |= dict.fromkeys(_SCRATCH, ("scratch", ""))
    shown = [*_system(), *python_places(), *environment_of(program), *map(os.fspath, read)]
    rooms = secluded_rooms([*shown, "/usr/local", *glob("/opt/*")])
    groups: Sequence[tuple[str, Iterable[str | Path]]] = (
        ("read", shown),
        ("hidden", [*checkout(), *rooms, *hidden]),
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
    devices = [path for name in _DEVICES for path in glob(f"/dev/{name}")]
    named = {"/": _SYSTEM, "/etc/": _ETC, "/sys/": _SYS}
    return [f"{top}{name}" for top, names in named.items() for name in names] + devices


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
