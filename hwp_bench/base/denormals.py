"""Denormal numbers are flushed to zero: on many processors one costs as much as a hundred others.

Denormals are the floats below 1.2e-38 (float32) or 2.2e-308 (float64). Every thread of a processor
has a switch of its own; a new thread takes over that of the thread that starts it. So a process
that is switched before it starts any thread computes without denormals everywhere, whoever starts
the threads: torch, OpenMP, BLAS or Python. Processes that we start are (`flushed_process`), for
their lifetime. In the process of somebody who imports us, a thread is only while we compute in it.

The switch is set through the C library, which needs no compiler and none of the packages that
compute. It is known for Linux and macOS on x86-64 and ARM; elsewhere nothing is changed.
"""

from __future__ import annotations

import functools
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

#: Where the C library's `fenv_t` has the control register (in words of 32 bits), and its bits that
#: flush results (x86-64: and operands) to zero.
_REGISTERS = {
    ("linux", "x86_64"): (7, 0x8040),
    ("linux", "aarch64"): (0, 1 << 24),
    ("darwin", "x86_64"): (1, 0x8040),
    ("darwin", "arm64"): (2, 1 << 24),
}
#: Room for any `fenv_t`, in words.
_WORDS = 64
#: The least normal float64; not a constant, which the interpreter would multiply beforehand.
_LEAST = [sys.float_info.min]


def flushes() -> bool:
    """Whether the calling thread flushes denormals to zero."""
    return _LEAST[0] * 0.5 == 0.0


def set_flush(on: bool) -> bool:
    """Switch the calling thread.

    Args:
        on: flush denormals to zero, or compute with them.

    Returns:
        Whether it flushed before.
    """
    before = flushes()
    library = _library() if on != before else None
    if library is not None:
        place, bits = _REGISTERS[_machine()]
        state = library.state()
        if library.fegetenv(state) == 0:
            state[place] = state[place] | bits if on else state[place] & ~bits
            library.fesetenv(state)
    return before


@contextmanager
def flushed() -> Iterator[None]:
    """Flush denormals in the calling thread, and in threads that it starts, while this holds."""
    before = set_flush(True)
    try:
        yield
    finally:
        set_flush(before)


@contextmanager
def flushed_process() -> Iterator[None]:
    """Flush denormals in a process of ours: around its main function, before it imports NumPy."""
    with warnings.catch_warnings():
        # Some versions of NumPy warn when they find the switch set.
        warnings.filterwarnings("ignore", message="The value of the smallest subnormal")
        with flushed():
            yield


def _machine() -> tuple[str, str]:
    return sys.platform, os.uname().machine if hasattr(os, "uname") else ""


@functools.cache
def _library() -> Any:
    """The C library's functions; None where the register's place is not known."""
    if _machine() not in _REGISTERS or sys.maxsize < 2**32:
        return None
    import ctypes

    names = (None, "libm.so.6", "libm.dylib")
    for name in names:
        try:
            library: Any = ctypes.CDLL(name)
            for function in (library.fegetenv, library.fesetenv):
                function.argtypes = [ctypes.c_void_p]
        except (OSError, AttributeError):
            continue
        library.state = ctypes.c_uint32 * _WORDS
        return library
    return None
