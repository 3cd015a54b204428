"""How the kernels are compiled: cached on disk where that is possible, never with fast-math."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

#: Untyped: the types that numba declares differ between its versions.
_njit: Any = numba.njit
_OPTIONS: dict[str, Any] = {"nogil": True, "boundscheck": False, "error_model": "numpy"}


class Kernel:
    """A compiled function that Python calls; it releases the interpreter lock.

    The machine code is kept next to the module or, where that folder is read-only, in the user's
    cache folder (`NUMBA_CACHE_DIR` names another). Where neither can be written, every process
    compiles for itself.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self._function = function
        try:
            self.dispatcher = _njit(cache=True, **_OPTIONS)(function)
        except RuntimeError:  # numba found no folder to write to
            self.dispatcher = _njit(**_OPTIONS)(function)
        self._index: Any = getattr(getattr(self.dispatcher, "_cache", None), "_cache_file", None)
        if self._index is not None and hasattr(self._index, "_source_stamp"):
            # Numba checks only the kernel's own module, and its date rather than its text, so it
            # would run stale code after a change to a function that the kernel calls.
            self._index._source_stamp = sources_digest()

    def __call__(self, *args: Any) -> Any:
        """Runs the machine code; compiles it if need be."""
        return self.dispatcher(*args)

    def on_disk(self) -> bool:
        """Whether the cache holds a version of this kernel, as far as can be told."""
        try:
            return bool(self._index._load_index())
        except Exception:  # no cache, an unreadable one, or another numba inside
            return False

    def compiled_here(self) -> int:
        """How many versions this process had to compile."""
        return len(self.dispatcher.signatures) - sum(self.dispatcher.stats.cache_hits.values())

    def forget_cache(self) -> None:
        """Goes on without the disk."""
        self.dispatcher = _njit(**_OPTIONS)(self._function)
        self._index = None


def kernel(function: Callable[..., Any]) -> Kernel:
    """Decorator: compiles a function that Python calls."""
    return Kernel(function)


def inline(function: Callable[..., Any]) -> Any:
    """Decorator: compiles a function into the kernels that call it."""
    return _njit(forceinline=True, **_OPTIONS)(function)


@functools.cache
def sources_digest() -> str:
    """Digest of all that the machine code depends on."""
    here = Path(__file__).parent
    digest = hashlib.sha256()
    for path in (*sorted(here.glob("*.py")), here.parent / "conventions.py"):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()
