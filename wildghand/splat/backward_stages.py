"""The stages of the CPU backend's backward pass, from arrays to arrays."""

from __future__ import annotations

import numpy as np

from wildghand.splat.kernels.blend_backward import background_backward, blend_backward
from wildghand.splat.kernels.channels import slot_size
from wildghand.splat.kernels.project import PIECE, Ellipsoids, Projected
from wildghand.splat.kernels.project_backward import PlaneGradients, project_backward
from wildghand.splat.kernels.reduce import BlendGradients, reduce_slots
from wildghand.splat.memory import lease
from wildghand.splat.scene import Options
from wildghand.splat.stages import (
    UNROLLED,
    Drawn,
    Lists,
    kernel_channels,
    repeat_of,
    tile_jobs,
    view_of,
)
from wildghand.splat.threads import even_jobs, run, thread_count

#: Pixels of the background's gradient that take as long as a (Gaussian, tile) pair.
_PIXELS_LIKE_A_PAIR = 20


def blend_backward_stage(
    projected: Projected,
    lists: Lists,
    opacities: np.ndarray,
    colors: np.ndarray,
    drawn: Drawn,
    images: np.ndarray,
    v_images: np.ndarray,
    v_alphas: np.ndarray,
    options: Options,
    gradients: BlendGradients,
) -> None:
    """Fills `gradients`.

    Args:
        projected, lists, drawn, images: as the forward pass left them.
        opacities: (S, N) float32, as blended.
        colors: (S, N, D) float32.
        v_images, v_alphas: gradients of the loss, (I, H, W, D) and (I, H, W, 1) or (0,).
        options: of the call.
        gradients: overwritten.
    """
    count, gaussians = projected.depths.shape
    size = colors.shape[-1]
    looked_at = drawn.stops - lists.start[:-1]
    first_slot = np.cumsum(looked_at) - looked_at
    floats = slot_size(size, size in UNROLLED)
    slots = lease((int(looked_at.sum()), floats), np.float32)
    slot_of = lease((len(lists.entries),), np.int32)
    pieces = max(1, gaussians // PIECE)
    run(
        blend_backward,
        tile_jobs(np.append(first_slot, len(slots))),
        lists.start,
        drawn.stops,
        first_slot,
        lists.entries,
        projected.geom.reshape(-1),
        colors.reshape(-1),
        repeat_of(colors, count),
        options.width,
        options.height,
        gaussians,
        images.reshape(-1),
        drawn.remaining.reshape(-1),
        v_images.reshape(-1),
        v_alphas.reshape(-1),
        slots.reshape(-1),
        floats,
        slot_of,
        kernel_channels(size),
    )
    run(
        reduce_slots,
        even_jobs(pieces, thread_count(pieces, count * gaussians)),
        projected.geom,
        projected.depths,
        opacities,
        lists.first_entry,
        slot_of,
        slots,
        gradients,
    )


def background_backward_stage(v_images: np.ndarray, remaining: np.ndarray) -> np.ndarray:
    """Gradient of the backgrounds, (I, D) float64."""
    count, height, width, size = v_images.shape
    lines = np.empty((count, height, size))
    work = count * height * width // _PIXELS_LIKE_A_PAIR
    run(
        background_backward,
        even_jobs(count * height, thread_count(count * height, work)),
        v_images,
        remaining,
        lines,
    )
    return lines.sum(1)


def project_backward_stage(
    ellipsoids: Ellipsoids,
    cameras: np.ndarray,
    projected: Projected,
    upstream: PlaneGradients,
    options: Options,
    want_cameras: bool,
    gradients: Ellipsoids,
) -> np.ndarray:
    """Fills `gradients`.

    Args:
        ellipsoids, cameras: as projected.
        projected: from the forward pass.
        upstream: gradients of the loss by the projected Gaussians.
        options: of the call.
        want_cameras: whether the result is needed.
        gradients: overwritten.

    Returns:
        Gradients of the cameras, (I, 12) float64: rotation row by row, then translation.
    """
    count, gaussians = projected.depths.shape
    pieces = max(1, gaussians // PIECE)
    v_cameras = np.zeros((count, pieces if want_cameras else 0, 12))
    run(
        project_backward,
        even_jobs(pieces, thread_count(pieces, count * gaussians)),
        ellipsoids,
        cameras,
        projected.depths,
        view_of(options),
        upstream,
        gradients,
        v_cameras,
    )
    return v_cameras.sum(1)
