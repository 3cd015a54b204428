"""A cache of a test's own."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable
from pathlib import Path

from hwp_bench.base.files import cache_root
from hwp_bench.base.kernels import code_folder


def compile_fits() -> None:
    """Compile what fits and drawing need."""
    from wildghand.fitting.method import ready_fit

    ready_fit("cpu")


def compile_renders() -> None:
    """Compile what rendering needs, and paint the skin of `capture0`'s subject."""
    from hwp_bench.sim.render.frame import render_frame
    from hwp_bench.sim.scene_files import load_scene

    render_frame(load_scene("capture0"), 0, 10, 32)


#: What processes of the suite would otherwise each compile, at the same time.
COMPILED: dict[str, Callable[[], None]] = {"fits": compile_fits, "renders": compile_renders}


def make_own_cache(folder: Path, *, skins: bool = False) -> Path:
    """Make a folder for `HWP_CACHE` with nothing in it but the machine code that is known by now.

    Compiling takes longer than most of what such tests do; `test_machine_code.py` tests it.

    Args:
        folder: to make.
        skins: share painted skins with the suite's cache; painting one takes 8 seconds.
    """
    kernels = folder / "kernels"
    kernels.mkdir(mode=0o700, parents=True)
    for path in code_folder().glob("*.code"):
        with contextlib.suppress(FileNotFoundError):  # another process has made room
            shutil.copy2(path, kernels / path.name)
    if skins:
        painted = cache_root().absolute() / "sim" / "skin"
        painted.mkdir(parents=True, exist_ok=True)
        (folder / "sim").mkdir()
        (folder / "sim" / "skin").symlink_to(painted)
    return folder
