"""Starts a module of ours as a process: `python -m hwp_bench.run.start MODULE ARGUMENT...`.

Denormals are flushed before the module is imported, so that the threads which its imports start
(those of NumPy's BLAS are the first) flush them too. How many those are is said before as well.
"""

from __future__ import annotations

import importlib
import sys

from hwp_bench.base.numerics import flushed_process, share_processors


def main() -> int:
    """Run the `main` of the module that the first argument names; returns the exit status."""
    del sys.argv[0]
    share_processors()
    with flushed_process():
        status: int = importlib.import_module(sys.argv[0]).main()
    return status


if __name__ == "__main__":
    sys.exit(main())
