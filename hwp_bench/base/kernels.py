"""Functions that numba compiles to machine code, which is kept on disk.

Numba's own cache asks for the path and the date of a module. So every new environment compiles
again, and a change in an imported module goes unnoticed. Here the name of a file is a digest of all
that the code depends on: a second installation of the same kernels finds it, and changed kernels
have another name. Processes that compile at the same time write the same content.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import os
import pickle
import re
import sys
import time
from collections.abc import Callable
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


#: Packages whose functions are kept.
_OURS = ("hwp_bench", "wildghand")
#: Source that is newer than this process may not be what was imported.
_STARTED = time.time()


def code_folder() -> Path:
    """Return the folder where machine code is kept."""
    return Path(os.environ.get(KEPT) or cache_root() / "kernels")


#: Untyped: the types that numba declares differ between its versions.
_njit: Any = numba.njit


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator: compile a function on first use; the machine code is kept on disk.

    It lies in the folder `kernels` of `HWP_CACHE`. Functions of other packages, and those that read
    variables of a function around them, are compiled in every process. Bounds are not checked, and
    a division by zero gives what NumPy gives.
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
    """
    return _njit(
        boundscheck=False,
        error_model="numpy",
        no_cpython_wrapper=True,
        no_cfunc_wrapper=True,
        **options,
    )(function)


def on_disk(dispatcher: Any) -> bool:
    """Return whether the disk holds machine code of a compiled function, by what can be checked."""
    cache = getattr(dispatcher, "_cache", None)
    return isinstance(cache, MachineCode) and cache.on_disk()


def _without_collections(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function; while it runs, Python looks for no garbage.

    A compiler makes millions of objects that stay until it is done. Looking through them, and
    through those of torch, again and again takes a sixth of its time.
    """

    @functools.wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        on = gc.isenabled()
        gc.disable()
        try:
            return function(*args, **options)
        finally:
            if on:
                gc.enable()

    return call


@helper
def dot(a: np.ndarray, b: np.ndarray) -> float:
    """Scalar product of two vectors (3,).

    The sum is written out: a library's order of summing depends on the processor.
    """
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@helper
def cross(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    """Vector product of two vectors (3,), written into `out`, which is neither of them."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


class MachineCode:
    """Keeps the versions of one function; numba's dispatcher calls it in place of its own cache.

    A file is the digest of its content, then a pickle of its key and of what numba needs. A file
    that is damaged, or that others could have written, is as good as none.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self._function = function
        self._options = options

    @property
    def cache_path(self) -> str:
        """The folder."""
        return str(code_folder())

    def on_disk(self) -> bool:
        """Whether the disk holds a version of this function, by what can be checked."""
        prefix = self._prefix()
        places = [] if prefix is None else _folders()
        return any(any(folder.glob(f"{prefix}-*{_SUFFIX}")) for folder in places)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled version for a signature, or None."""
        key = self._key(sig, target_context.codegen())
        if key is None:
            return None
        target_context.refresh()
        for folder in _folders():
            with contextlib.suppress(Exception):  # another numba inside, or a class that is gone
                raw = read_private(folder / self._name(key), MAX_BYTES)
                if raw is not None and hashlib.sha256(raw[32:]).digest() == raw[:32]:
                    stored, payload = pickle.loads(raw[32:])
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
        """All that the machine code depends on; None if it cannot be determined."""
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


@functools.cache
def kernel_digest(module: str) -> str | None:
    """SHA-256 (hex) of a module and all that it imports of the toolkit, directly or not.

    None if the module is not of the toolkit, or some text may differ from what this process has
    imported.
    """
    files = kernel_modules(module)
    digest = hashlib.sha256()
    for name, path in files.items():
        status = path.stat()
        if max(status.st_mtime, status.st_ctime) >= _STARTED:
            return None
        text = path.read_bytes()
        digest.update(f"{name} {len(text)} ".encode() + text)
    return digest.hexdigest() if files else None


def kernel_modules(module: str, root: Path = PACKAGES) -> dict[str, Path]:
    """The files of a module and of all that it imports of the packages in a folder, by name.

    What this file imports is left out: how a kernel is compiled is part of its key.
    """
    found: dict[str, Path] = {}
    pending = [module] if module.partition(".")[0] in _OURS else []
    while pending:
        name = pending.pop()
        path = _file(name, root)
        if path is None or name in found:
            continue
        found[name] = path
        for source, names in [] if name == __name__ else _imports(path.read_text("utf-8")):
            # A name is a module of a package, or stands in the file itself.
            parts = names.strip("( \n").split(",")
            inner = [f"{source}.{part.split()[0]}" for part in parts if part.strip()]
            pending += [one if _file(one, root) else source for one in inner or [source]]
    return dict(sorted(found.items()))


#: Statements that import of the toolkit, at the top of a file or in a function.
_IMPORT = re.compile(
    rf"^ *(?:from|import) ((?:{'|'.join(_OURS)})[.\w]*)(?: import (\([^)]*|.*))?", re.MULTILINE
)
# Many kernels import the same files.
_imports = functools.cache(_IMPORT.findall)


def _file(module: str, root: Path) -> Path | None:
    place = root.joinpath(*module.split("."))
    files = (place.with_name(f"{place.name}.py"), place / "__init__.py")
    return next((path for path in files if path.is_file()), None)


def _folders() -> list[Path]:
    """Where machine code may lie: this user's cache, then one that is only read."""
    shared = os.environ.get(SHARED)
    return [code_folder(), *([Path(shared)] if shared else [])]


@functools.cache
def _surroundings() -> tuple[str, ...]:
    """Versions and settings of what compiles. Constants of kernels are computed with NumPy."""
    settings = [f"{name}={getattr(config, name, None)}" for name in _SETTINGS]
    python = f"{sys.implementation.cache_tag}{getattr(sys, 'abiflags', '')} {sys.version_info[:3]}"
    return (python, numba.__version__, llvmlite.__version__, np.__version__, *settings)


def _hex(value: object) -> str:
    return hashlib.sha256(repr(value).encode()).hexdigest()[:20]
