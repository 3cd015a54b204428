"""Variables that tell numerical libraries how their threads wait, and how many there are.

A library reads its variables when it is loaded, so they are set before: how threads wait when
`hwp_bench` is imported, and how many BLAS has before a process of ours imports its work.
Processes that we start inherit both. What a person has set stays.

Threads that wait for their next piece of work either sleep or spin. Beside another busy process
those that spin take the processor from the one that they wait for, so that a step takes ten times
as long. torch's OpenMP (GNU's, LLVM's and Intel's) and OpenCV's pool can be told to sleep. The pool
of OpenBLAS, which NumPy and SciPy have, cannot: it gets one thread. Numba's pool starts
only with functions that are compiled with `parallel=True`, of which we have none.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping

from hwp_bench.base.errors import UsageError

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
    """Return the variables by which threads that wait sleep, without those that a person has set.

    Args:
        environment: what is set.
    """
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
    """Check what a person has set, which libraries ignore or end the process for.

    Args:
        environment: what is set.

    Raises:
        UsageError: a number of threads is none from 1 to 1024, or threads are to wait in an
            unknown way.
    """
    for name in dict.fromkeys((*TORCH_COUNTS, *BLAS_COUNTS, "NUMBA_NUM_THREADS")):
        text = environment.get(name, "").strip()
        # OpenMP takes a number for each depth of nested regions.
        numbers = text.split(",") if name == "OMP_NUM_THREADS" else [text]
        if text and not all(_is_count(number.strip()) for number in numbers):
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


def _is_count(text: str) -> bool:
    return _COUNT.fullmatch(text) is not None and 1 <= int(text) <= MOST_THREADS


def count_is_chosen(environment: Mapping[str, str]) -> bool:
    """Whether a person, or the engine that runs several jobs, says how many threads torch has.

    Args:
        environment: what is set.
    """
    return any(environment.get(name, "").strip() for name in TORCH_COUNTS)
