"""How the kernels are compiled: cached on disk where possible, never with fast-math."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

_OPTIONS = {"nogil": True, "boundscheck": False, "error_model": "numpy"}


def kernel(function: Callable[..., Any]) -> Any:
    """Compiles a function that Python calls; it releases the interpreter lock.

    The machine code is kept beside the module or, if that folder is read-only, in the user's
    cache folder (`NUMBA_CACHE_DIR` names another). Where neither can be written the kernel is
    compiled anew in every process.
    """
    try:
        return njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # numba: "no locator available", nowhere to keep it
        return njit(**_OPTIONS)(function)


def inline(function: Callable[..., Any]) -> Any:
    """Compiles a function into the kernels that call it."""
    return njit(forceinline=True, **_OPTIONS)(function)
