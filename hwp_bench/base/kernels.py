"""Digest of the sources of compiled functions: their module, and what it imports of the toolkit."""

from __future__ import annotations

import ast
import contextlib
import functools
import gc
import hashlib
import os
import pickle
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import config
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from hwp_bench.base.files import cache_root
from hwp_bench.base.folders import read_private, trim, write_private
from hwp_bench.base.packages import PACKAGES

#: Packages whose imports are followed; versions stand for others.
OURS = ("hwp_bench", "wildghand")
#: Modules that compile, keep and load; they do not change what a kernel computes. How a kernel is
#: compiled is part of its key.
MACHINERY = ("hwp_bench.base.kernels", "hwp_bench.base.kernels")

#: Source that is newer than this process may not be what was imported.
_STARTED = time.time()


@functools.cache
def kernel_digest(module: str) -> str | None:
    """Return the digest of all that a module's compiled functions are made from.

    Args:
        module: its dotted name.

    Returns:
        SHA-256 (hex) of the names and texts of the module and of what it imports of the toolkit,
        directly or not; None if the module is not of the toolkit, or some text may differ from
        what this process has imported.
    """
    if module.partition(".")[0] not in OURS or source_of(module) is None:
        return None
    digest = hashlib.sha256()
    for name, path in kernel_modules(module).items():
        status = path.stat()
        if max(status.st_mtime, status.st_ctime) >= _STARTED:
            return None
        text = path.read_bytes()
        digest.update(f"{name} {len(text)} ".encode())
        digest.update(text)
    return digest.hexdigest()


def kernel_modules(module: str, root: Path = PACKAGES) -> dict[str, Path]:
    """Return the files of a module and of all it imports of the toolkit, sorted by name.

    Args:
        module: a dotted name.
        root: the folder that holds the packages.
    """
    found: dict[str, Path] = {}
    pending = [module]
    while pending:
        name = pending.pop()
        path = source_of(name, root)
        if path is not None and name not in found and name not in MACHINERY:
            found[name] = path
            pending += _imports(path, name, root)
    return dict(sorted(found.items()))


def source_of(module: str, root: Path = PACKAGES) -> Path | None:
    """Return the file of a module or package; None if there is none."""
    place = root.joinpath(*module.split("."))
    for path in (place.with_name(f"{place.name}.py"), place / "__init__.py"):
        if path.is_file():
            return path
    return None


def _imports(path: Path, module: str, root: Path) -> Iterator[str]:
    """The toolkit's modules that a file imports, wherever in it."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for source, member in _imported_names(path.read_bytes(), package):
        # A name is a module of a package, or stands in the file itself.
        inner = f"{source}.{member}"
        yield inner if member and source_of(inner, root) else source


@functools.cache
def _imported_names(text: bytes, package: str) -> tuple[tuple[str, str], ...]:
    """The toolkit's modules that a file of a package imports, each with a name in it or with none.

    Parsing takes most of the time, and many kernels import the same files.
    """
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found += [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1]
            parts = [*(above if node.level else []), *([node.module] if node.module else [])]
            found += [(".".join(parts), alias.name) for alias in node.names]
    return tuple(pair for pair in found if pair[0].partition(".")[0] in OURS)


#: Bytes of one function, and of all that are kept.
MAX_BYTES, MAX_CACHE_BYTES = 64 * 2**20, 256 * 2**20
#: Environment variable: a second folder, which is only read. Methods in a sandbox get the
#: toolkit's here, because they may not write where others read.
SHARED = "HWP_KERNELS"
#: Environment variable: the folder where machine code is kept in place of the cache's. Methods that
#: ship with the toolkit get the toolkit's here, whatever cache they have otherwise.
KEPT = "HWP_KEPT_KERNELS"

_SUFFIX = ".code"
#: Settings of numba that change machine code.
_SETTINGS = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "BOUNDSCHECK", "DEBUGINFO_DEFAULT")


def code_folder() -> Path:
    """Return the folder where machine code is kept."""
    return Path(os.environ.get(KEPT) or cache_root() / "kernels")


class MachineCode:
    """Keeps the versions of one function; numba's dispatcher calls it in place of its own cache.

    A file is the digest of its content, then a pickle of its key and of what numba needs. A file
    that is damaged, or that others could have written, is as good as none.

    Args:
        function: the Python function.
        options: the options of `numba.njit` that it is compiled with.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self._function = function
        self._options = options

    @property
    def cache_path(self) -> str:
        """The folder."""
        return str(code_folder())

    def on_disk(self) -> bool:
        """Whether the disk holds a version of this function, as far as can be told."""
        return any(self._files(folder) for folder in _folders())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled version for a signature, or None."""
        key = self._key(sig, target_context.codegen())
        if key is None:
            return None
        target_context.refresh()
        for folder in _folders():
            with contextlib.suppress(Exception):  # another numba inside, or a class that is gone
                content = _read(folder / self._name(key))
                if content is not None:
                    stored, payload = pickle.loads(content)
                    if stored == (key, sig):
                        return CompileResult._rebuild(target_context, *payload)
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a version that has just been compiled; a full disk is not an error."""
        key = self._key(sig, data.codegen)
        if key is None or data.lifted or data.library.has_dynamic_globals:
            return
        # The annotated source is for people who inspect a function, and slow to make.
        content = dumps(((key, sig), data._replace(type_annotation="")._reduce()))
        digest = hashlib.sha256(content).digest()
        if write_private(code_folder() / self._name(key), digest + content):
            trim(code_folder(), _SUFFIX, MAX_CACHE_BYTES)

    def _key(self, sig: Any, codegen: Any) -> tuple[str, ...] | None:
        """All that the machine code depends on; None if that cannot be told."""
        prefix = self._prefix()
        if prefix is None:
            return None
        return (prefix, str(sig), repr(codegen.magic_tuple()), *_surroundings())

    def _prefix(self) -> str | None:
        """How the names of all versions begin; None if they are not to be kept."""
        function = self._function
        sources = kernel_digest(function.__module__)
        if sources is None or function.__closure__ is not None:
            return None
        code = function.__code__
        made = (sources, function.__qualname__, code.co_firstlineno, sorted(self._options.items()))
        return f"{function.__module__}.{function.__name__}-{_hex(made)}"

    def _name(self, key: tuple[str, ...]) -> str:
        return f"{key[0]}-{_hex(key)}{_SUFFIX}"

    def _files(self, folder: Path) -> list[Path]:
        prefix = self._prefix()
        return [] if prefix is None else sorted(folder.glob(f"{prefix}-*{_SUFFIX}"))


def _folders() -> list[Path]:
    """Where machine code may lie: this user's cache, then one that is only read."""
    shared = os.environ.get(SHARED)
    return [code_folder(), *([Path(shared)] if shared else [])]


def _read(path: Path) -> bytes | None:
    """The content of a file that is whole and private."""
    raw = read_private(path, MAX_BYTES)
    if raw is None or hashlib.sha256(raw[32:]).digest() != raw[:32]:
        return None
    return raw[32:]


@functools.cache
def _surroundings() -> tuple[str, ...]:
    """Versions and settings of what compiles. Constants of kernels are computed with NumPy."""
    settings = [f"{name}={getattr(config, name, None)}" for name in _SETTINGS]
    python = f"{sys.implementation.cache_tag}{getattr(sys, 'abiflags', '')} {sys.version_info[:3]}"
    return (python, numba.__version__, llvmlite.__version__, np.__version__, *settings)


def _hex(value: object) -> str:
    return hashlib.sha256(repr(value).encode()).hexdigest()[:20]


#: Untyped: the types that numba declares differ between its versions.
_njit: Any = numba.njit


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator: compile a function on first use; the machine code is kept on disk.

    It lies in the folder `kernels` of `HWP_CACHE` and is found by what it was made from
    (`machine_code`). Functions of other packages, and those that read variables of a function
    around them, are compiled in every process. Bounds are not checked, and a division by zero gives
    what NumPy gives.

    Args:
        options: further options of `numba.njit`, such as `nogil=True`.
    """
    # Nothing calls a kernel from C.
    settings = {"boundscheck": False, "error_model": "numpy", "no_cfunc_wrapper": True, **options}

    def compile_function(function: Callable[..., Any]) -> Any:
        dispatcher: Any = _njit(**settings)(function)
        if hasattr(dispatcher, "signatures"):  # not if NUMBA_DISABLE_JIT is set
            dispatcher._cache = MachineCode(function, settings)
            dispatcher.compile = _without_collections(dispatcher.compile)
        return dispatcher

    return compile_function


def helper(function: Callable[..., Any], **options: Any) -> Any:
    """Decorator: compile a function for the compiled functions that call it.

    Python cannot call it, and the disk does not keep it: its code is part of theirs. Wrappers for
    callers outside would take a tenth of the time.

    Args:
        function: to compile.
        options: further options of `numba.njit`.
    """
    return _njit(
        boundscheck=False,
        error_model="numpy",
        no_cpython_wrapper=True,
        no_cfunc_wrapper=True,
        **options,
    )(function)


def on_disk(dispatcher: Any) -> bool:
    """Return whether the disk holds machine code of a compiled function, as far as can be told."""
    cache = getattr(dispatcher, "_cache", None)
    return isinstance(cache, MachineCode) and cache.on_disk()


def _without_collections(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function; while it runs, Python looks for no garbage.

    A compiler makes millions of objects that stay until it is done. Looking through them, and
    through those of torch, again and again takes a sixth of its time.
    """

    @functools.wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        with _no_collections():
            return function(*args, **options)

    return call


@contextlib.contextmanager
def _no_collections() -> Iterator[None]:
    """Switches the collector off, if it is on, and on again."""
    on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if on:
            gc.enable()


@helper
def dot(a: np.ndarray, b: np.ndarray) -> float:
    """Scalar product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@helper
def cross(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    """Vector product of two vectors (3,), written into `out`, which is neither of them."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
