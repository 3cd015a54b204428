"""CPU backend: the compiled kernels behind torch tensors."""

from __future__ import annotations

from typing import Any

import torch

from wildghand.splat.autograd import Blend, Call, Project
from wildghand.splat.scene import (
    FlatScene,
    channel_count,
    channels_with_depth,
    expected_depth,
    per_image,
    unflattened,
)
from wildghand.splat.stages import camera_rows
from wildghand.splat.warmup import warm_up


def rasterize_numba(scene: FlatScene) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Draws the scene, float32 on the CPU; see `wildghand.splat.rasterize`.

    Returns:
        channels (I, H, W, X), alphas (I, H, W, 1) and the backend's part of `info`.
    """
    options = scene.options
    warm_up(channel_count(scene))
    call = Call(
        options,
        camera_rows(
            scene.viewmats.detach().double().contiguous().numpy(),
            scene.Ks.detach().double().contiguous().numpy(),
            options,
        ),
    )
    means2d, shapes, depths, compensations = Project.apply(
        scene.means.contiguous(),
        scene.quats.contiguous(),
        scene.scales.contiguous(),
        scene.viewmats,
        scene.opacities.contiguous(),
        scene.colors.contiguous(),
        call,
    )
    # The caller's tensor lies on the way, so that its gradient can be kept.
    info_means2d = unflattened(means2d, scene)
    opacities = scene.opacities
    if options.antialiased:
        opacities = per_image(opacities, scene.images) * compensations
    channels, backgrounds = channels_with_depth(scene.colors, depths, scene)
    if backgrounds is None:
        backgrounds = torch.zeros(scene.images, channels.shape[-1])
    images, alphas = Blend.apply(
        info_means2d.reshape(means2d.shape),
        shapes,
        opacities.contiguous(),
        channels.contiguous(),
        backgrounds.contiguous(),
        call,
    )
    info: dict[str, Any] = {
        "means2d": info_means2d,
        "depths": unflattened(depths, scene),
        "radii": unflattened(torch.from_numpy(call.projected.radii)[:, : scene.gaussians], scene),
        "visible": unflattened(torch.from_numpy(call.lists.visible), scene),
    }
    if options.count_pairs:
        pairs = torch.from_numpy(call.drawn.pairs).reshape(scene.images, -1).sum(1)
        info["pairs"] = unflattened(pairs, scene)
    return expected_depth(images, alphas, options.render_mode), alphas, info
