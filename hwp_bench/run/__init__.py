"""Run a method: `runner` and `worker`, in a `sandbox`; an `engine` says where jobs run.

The launcher of the sandbox imports this package with the standard library alone.
"""

from __future__ import annotations

import importlib
import sys

#: What an interpreter is given to `start` a module of ours; then come the module and its arguments.
START = ("-c", "import sys; from hwp_bench.run import start; sys.exit(start())")


def start() -> int:
    """Run the `main` of the module that the first argument names; returns the exit status.

    Denormals are flushed before the module is imported, so that the threads which its imports
    start (those of NumPy's BLAS are the first) flush them too. Their number is set before, too.
    """
    from hwp_bench.base.numerics import flushed_process, share_processors

    del sys.argv[0]
    share_processors()
    with flushed_process():
        status: int = importlib.import_module(sys.argv[0]).main()
    return status
