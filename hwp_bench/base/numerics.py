"""How libraries compute in our processes: threads that sleep, denormals that are zero.

A library reads its variables when it is loaded, so they are set before: how threads wait when
`hwp_bench` is imported, and how many BLAS has before a process of ours imports its work.
Processes that we start inherit both. What a person has set stays.

Threads that wait for their next piece of work either sleep or spin. Beside another busy process
those that spin take the processor from the one that they wait for, so that a step takes ten times
as long. torch's OpenMP (GNU's, LLVM's and Intel's) and OpenCV's pool can be told to sleep. The pool
of OpenBLAS, which NumPy and SciPy have, cannot: it gets one thread. Numba's pool starts
only with functions that are compiled with `parallel=True`, of which we have none.

Denormal numbers are flushed to zero: on many processors one costs as much as a hundred others.
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
import re
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from hwp_bench.base.errors import UsageError

if TYPE_CHECKING:
    import numpy as np
    from scipy.spatial import cKDTree


#: Variables by which a person says how the threads of OpenMP wait; each speaks for all.
OPENMP_WAITING = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME", "KMP_LIBRARY")
#: Turns for which threads of OpenCV spin before they sleep.
OPENCV_WAITING = ("OPENCV_THREAD_POOL_ACTIVE_WAIT_MAIN", "OPENCV_THREAD_POOL_ACTIVE_WAIT_WORKER")
#: Variables by which a person says how many threads torch computes on.
TORCH_COUNTS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS")
#: The same of OpenBLAS; the first that is set holds.
BLAS_COUNTS = ("OPENBLAS_NUM_THREADS", "GOTO_NUM_THREADS", "OMP_NUM_THREADS")
#: Most threads that a variable may ask for.
MOST_THREADS = 1024

_COUNT = re.compile(r"[0-9]{1,9}")


def waiting_variables(environment: Mapping[str, str]) -> dict[str, str]:
    """Variables by which threads that wait sleep, without those that a person has set."""
    variables = {}
    if not any(name in environment for name in OPENMP_WAITING):
        variables["OMP_WAIT_POLICY"] = "PASSIVE"
    return variables | {name: "0" for name in OPENCV_WAITING if name not in environment}


def wait_passively() -> None:
    """Have threads of libraries that are loaded from now on sleep while they wait."""
    os.environ.update(waiting_variables(os.environ))


def share_processors() -> None:
    """Set up the threads of a process of ours, before it imports NumPy: BLAS has one.

    Products in this toolkit are small; a second thread of BLAS spins longer than it computes.
    """
    if not any(name in os.environ for name in BLAS_COUNTS):
        os.environ["OPENBLAS_NUM_THREADS"] = "1"


def check_thread_variables(environment: Mapping[str, str]) -> None:
    """Check what a person has set, which libraries ignore or end the process for."""
    most = MOST_THREADS
    for name in dict.fromkeys((*TORCH_COUNTS, *BLAS_COUNTS, "NUMBA_NUM_THREADS")):
        text = environment.get(name, "").strip()
        # OpenMP takes a number for each depth of nested regions.
        numbers = text.split(",") if name == "OMP_NUM_THREADS" else [text]
        counts = [int(each) for each in numbers if _COUNT.fullmatch(each.strip())]
        if text and (len(counts) < len(numbers) or not 1 <= min(counts) <= max(counts) <= most):
            raise UsageError(
                f"is {text[:40]!r}, not a number of threads from 1 to {MOST_THREADS}",
                field=name,
                remedy="Correct the environment variable, or unset it.",
            )
    policy = environment.get("OMP_WAIT_POLICY", "").strip()
    if policy and policy.upper() not in ("ACTIVE", "PASSIVE"):
        raise UsageError(
            f"is {policy[:40]!r}, neither ACTIVE nor PASSIVE",
            field="OMP_WAIT_POLICY",
            remedy="Correct the environment variable, or unset it.",
        )


def count_is_chosen(environment: Mapping[str, str]) -> bool:
    """Whether a person, or the engine that runs several jobs, says how many threads torch has."""
    return any(environment.get(name, "").strip() for name in TORCH_COUNTS)


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
    """Switch the calling thread."""
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

    for name in (None, "libm.so.6", "libm.dylib"):
        try:
            library: Any = ctypes.CDLL(name)
            for function in (library.fegetenv, library.fesetenv):
                function.argtypes = [ctypes.c_void_p]
        except (OSError, AttributeError):
            continue
        library.state = ctypes.c_uint32 * _WORDS
        return library
    return None


def kd_tree(points: np.ndarray) -> cKDTree:
    """Build a tree over points.

    Where half of the points share their least coordinate, SciPy splits at the next number above
    it. Above 0 that is a denormal number. A thread that flushes these reads it as 0 again, and
    the build calls itself until the process dies. So the thread keeps denormals while it builds;
    queries do not need them.

    Args:
        points: (N, D), finite.
    """
    from scipy.spatial import cKDTree

    before = set_flush(False)
    try:
        return cKDTree(points)
    finally:
        set_flush(before)
