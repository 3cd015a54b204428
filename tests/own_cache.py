"""A cache of a test's own."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

from hwp_bench.base.files import cache_root
from hwp_bench.base.kernels import code_folder


def compile_all() -> None:
    """Compile what fits, drawing and rendering need, and paint the skin of `capture0`'s subject.

    Processes of the suite would each do it otherwise, at the same time.
    """
    from hwp_bench.sim.render.frame import render_frame
    from hwp_bench.sim.scene.reader import load_scene
    from wildghand.fitting.ready import ready_fit

    ready_fit("cpu")
    render_frame(load_scene("capture0"), 0, 10, 32)


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
