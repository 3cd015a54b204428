"""Functions that numba compiles to machine code."""

from __future__ import annotations

import contextlib
import functools
import gc
from collections.abc import Callable, Iterator
from typing import Any

import numba

from hwp_bench.base.machine_code import MachineCode

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
