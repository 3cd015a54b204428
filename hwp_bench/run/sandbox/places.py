"""What a program in a sandbox sees of the file system: what it needs to run, and nothing more."""

from __future__ import annotations

import os
import site
import sys
from collections.abc import Iterable, Sequence
from glob import glob
from pathlib import Path

from hwp_bench.base.packages import PACKAGES
from hwp_bench.run.sandbox.root import Place

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
_DEVICES = ("null", "zero", "full", "random", "urandom", "nvidia*", "dri", "kfd")
_SCRATCH = ("/tmp", "/var/tmp", "/dev/shm")
_ENVIRONMENT_MARKS = ("pyvenv.cfg", "conda-meta")
_MOST_LINKS = 40


def visible_places(
    *,
    read: Iterable[Path],
    write: Iterable[Path],
    hidden: Iterable[Path] = (),
    program: str | None = None,
) -> list[Place]:
    """Return what a sandbox shows, outer places first.

    Args:
        read: files and folders that it may read, besides the system, Python and the toolkit.
        write: folders that it may write to.
        hidden: folders that stay empty even inside a folder that it may read.
        program: what is started; a Python environment that it lies in is shown.
    """
    chosen: dict[str, tuple[str, str]] = {
        "/proc": ("proc", ""),
        "/dev/fd": ("link", "/proc/self/fd"),
    }
    chosen |= dict.fromkeys(_SCRATCH, ("scratch", ""))
    groups: Sequence[tuple[str, Iterable[str | Path]]] = (
        ("read", [*_system(), *python_places(), *_environment(program), *read]),
        ("hidden", hidden),
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


def python_places() -> list[str]:
    """Return the folders of this interpreter, its packages and the toolkit."""
    root = os.fspath(PACKAGES)
    # In a checkout the packages are shown, not the runs and captures that may lie beside them.
    packages = [os.path.dirname(path) for path in glob(f"{root}/*/__init__.py")]
    sites = [*site.getsitepackages(), site.getusersitepackages()]
    linked = [path for path in _linked(sites) if os.path.realpath(path) != root]
    return [sys.prefix, sys.base_prefix, *packages, *sites, *linked]


def _linked(sites: Iterable[str]) -> list[str]:
    """Return the folders that `.pth` files add, as editable installs do."""
    files = [path for folder in sites for path in glob(f"{folder}/*.pth")]
    lines = [line for path in files for line in Path(path).read_text(errors="replace").splitlines()]
    return [line.strip() for line in lines if os.path.isabs(line) and os.path.isdir(line.strip())]


def _system() -> list[str]:
    devices = [path for name in _DEVICES for path in glob(f"/dev/{name}")]
    return [f"/{name}" for name in _SYSTEM] + [f"/etc/{name}" for name in _ETC] + ["/sys", *devices]


def _environment(program: str | None) -> list[str]:
    """Return the Python environment that a program lies in, and the one that it was made from.

    Nothing for other programs: a stranger's command must not choose what is shown.
    """
    if program is None or not os.path.isabs(program):
        return []
    prefix = os.path.dirname(os.path.dirname(program))
    if not any(os.path.exists(f"{prefix}/{mark}") for mark in _ENVIRONMENT_MARKS):
        return []
    return [prefix, os.path.dirname(os.path.dirname(os.path.realpath(program)))]


def _resolved(path: str) -> tuple[list[tuple[str, str]], str]:
    """Return the symbolic links on the way to a path, and where it really is."""
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
