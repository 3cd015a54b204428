"""A cache of a test's own."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

from hwp_bench.base.machine_code import code_folder


def make_own_cache(folder: Path) -> Path:
    """Make a folder for `HWP_CACHE` with nothing in it but the machine code that is known by now.

    Compiling takes longer than most of what such tests do; `test_machine_code.py` tests it.
    """
    kernels = folder / "kernels"
    kernels.mkdir(mode=0o700, parents=True)
    for path in code_folder().glob("*.code"):
        with contextlib.suppress(FileNotFoundError):  # another process has made room
            shutil.copy2(path, kernels / path.name)
    return folder
