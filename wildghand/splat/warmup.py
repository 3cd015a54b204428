"""The first call: compiles the kernels, or loads them, and says so when it takes long."""

from __future__ import annotations

import functools
import logging
import threading
import time

import numpy as np

from wildghand.splat import backward_stages, stages
from wildghand.splat.kernels.jit import Kernel
from wildghand.splat.kernels.project import Ellipsoids
from wildghand.splat.kernels.project_backward import PlaneGradients
from wildghand.splat.kernels.reduce import BlendGradients
from wildghand.splat.kernels.rows import GROUP
from wildghand.splat.scene import Options

_log = logging.getLogger("wildghand.splat")
_lock = threading.Lock()


def warm_up(channels: int = stages.UNROLLED[0]) -> None:
    """Makes the kernels ready; costs nothing from the second call on.

    Compiling takes some ten seconds, once on a machine. A person who waits is told on the log
    (level WARNING, which goes to standard error unless logging is set up otherwise).

    Args:
        channels: how many are to be blended. Numbers that are not unrolled share one version,
            which few programs need.
    """
    with _lock:
        _warm_up(channels if channels in stages.UNROLLED else None)


@functools.cache
def _warm_up(unrolled: int | None) -> None:
    kernels = all_kernels()
    before = sum(kernel.compiled_here() for kernel in kernels)
    if not all(kernel.on_disk() for kernel in kernels):
        _log.warning(
            "compiling the CPU rasterizer, once on this machine; it takes some ten seconds"
        )
    start = time.perf_counter()
    _draw_nothing(max(stages.UNROLLED) + 1 if unrolled is None else unrolled)
    if sum(kernel.compiled_here() for kernel in kernels) > before:
        _log.warning("compiled the CPU rasterizer in %.1f s", time.perf_counter() - start)


def all_kernels() -> list[Kernel]:
    """Every kernel that the stages call."""
    modules = (stages, backward_stages)
    return [
        value for module in modules for value in vars(module).values() if isinstance(value, Kernel)
    ]


def _draw_nothing(channels: int) -> None:
    """Runs every stage, forward and backward, on Gaussians that are all culled."""
    options = Options(1, 1, 0.01, 1e10, 0.3, "RGB", antialiased=False, count_pairs=False)

    def zeros(*shape: int) -> np.ndarray:
        return np.zeros(shape, np.float32)

    cameras = stages.camera_rows(np.eye(4)[None], np.eye(3)[None], options)
    opacities, colors = zeros(1, GROUP), zeros(1, GROUP, channels)
    ellipsoids = Ellipsoids(zeros(1, GROUP, 3), zeros(1, GROUP, 4), zeros(1, GROUP, 3))
    projected = stages.project_stage(ellipsoids, opacities, colors, cameras, options)
    lists = stages.list_stage(projected, options)
    image, alpha = zeros(1, 1, 1, channels), zeros(1, 1, 1, 1)
    drawn = stages.blend_stage(projected, lists, colors, zeros(1, channels), options, image, alpha)
    backward_stages.background_backward_stage(image, drawn.remaining)
    blended = BlendGradients(
        zeros(1, GROUP, 2), zeros(1, GROUP, 3), opacities, zeros(1, GROUP, channels)
    )
    backward_stages.blend_backward_stage(
        projected, lists, opacities, colors, drawn, image, image, alpha, options, blended
    )
    upstream = PlaneGradients(blended.means2d, blended.shapes, zeros(0, 0), zeros(1, GROUP))
    backward_stages.project_backward_stage(
        ellipsoids, cameras, projected, upstream, options, True, ellipsoids
    )
