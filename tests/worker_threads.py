"""One thread for each worker of pytest-xdist and for the processes that it starts.

Workers share the processor. NumPy, torch and numba read the variable when they are loaded, so this
is imported before them: a worker whose NumPy has two threads sums in another order than a process
that it starts, and the two differ in the last bits. How threads wait is said by `hwp_bench`, which
must therefore be imported before torch, too.
"""

from __future__ import annotations

import os
import sys

import hwp_bench  # noqa: F401

#: Whether this process is a worker.
WORKER = "PYTEST_XDIST_WORKER" in os.environ
#: Which one, from 0: the variable is gw0, gw1, ...
WORKER_NUMBER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
if WORKER:
    if "numpy" in sys.modules:
        raise RuntimeError("NumPy was loaded before tests/worker_threads.py could tell it how")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
