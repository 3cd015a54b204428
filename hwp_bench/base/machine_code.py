"""Machine code on disk, found by what it was made from, not by where the package lies.

Numba's own cache asks for the path and the date of a module. So every new environment compiles
again, and a change in an imported module goes unnoticed. Here the name of a file is a digest of all
that the code depends on: a second installation of the same kernels finds it, and changed kernels
have another name. Processes that compile at the same time write the same content.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import config
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from hwp_bench.base.caches import read_private, trim, write_private
from hwp_bench.base.files import cache_root
from hwp_bench.base.kernel_sources import kernel_digest

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
