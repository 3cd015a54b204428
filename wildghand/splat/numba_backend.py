"""CPU backend, first version: the study's kernels behind the final interface."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from wildghand.splat import _study
from wildghand.splat.scene import Scene, channels_with_depth, expected_depth, per_image


class _Image(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, scales, opacities, colors, background, viewmat, K, W, H, o):
        arrays = [x.detach().contiguous().numpy() for x in (means, quats, scales, opacities, colors)]
        finite = np.all([np.isfinite(x).reshape(len(x), -1).all(1) for x in arrays], 0)
        arrays[3] = np.where(finite, arrays[3], np.float32(0))
        v, k, b = (x.detach().contiguous().numpy() for x in (viewmat, K, background))
        out, T, state = _study.forward(
            *arrays, v, k, W, H, b, eps2d=o.eps2d, near=o.near_plane
        )
        state = tuple(x.copy() if isinstance(x, np.ndarray) else x for x in state)
        ctx.state = (arrays, v, k, W, H, b, out, T, state)
        return torch.from_numpy(out), torch.from_numpy(1 - T)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, v_out, v_alpha):
        arrays, v, k, W, H, b, out, T, state = ctx.state
        grads = _study.backward(
            state, out, T, v_out.contiguous().numpy(), v_alpha.contiguous().numpy(),
            *arrays[:4], v, k, W, H, b,
        )
        return (*(torch.from_numpy(g) for g in grads),
                (v_out * torch.from_numpy(T)[..., None]).sum((0, 1)), *(None,) * 5)


def rasterize_numba(scene: Scene) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Draws the scene; see `wildghand.splat.rasterize`."""
    o = scene.options
    if scene.viewmats.requires_grad:
        raise NotImplementedError("gradients to viewmats come with the next version")
    n = scene.images
    means, quats, scales, opacities = (
        per_image(x, n) for x in (scene.means, scene.quats, scene.scales, scene.opacities)
    )
    depths = (means * scene.viewmats[:, None, 2, :3]).sum(-1) + scene.viewmats[:, None, 2, 3]
    channels, backgrounds = channels_with_depth(scene.colors, depths, scene)
    channels = per_image(channels, n)
    D = channels.shape[-1]
    if backgrounds is None:
        backgrounds = means.new_zeros(n, D)
    images, alphas = [], []
    for i in range(n):
        parts = []
        for d in range(0, D, 3):
            pad = (0, 3 - min(3, D - d))
            c = torch.nn.functional.pad(channels[i][:, d : d + 3], pad)
            b = torch.nn.functional.pad(backgrounds[i][d : d + 3], pad)
            image, alpha = _Image.apply(
                means[i], quats[i], scales[i], opacities[i], c, b,
                scene.viewmats[i], scene.Ks[i], o.width, o.height, o,
            )
            parts.append(image)
        images.append(torch.cat(parts, -1)[..., :D])
        alphas.append(alpha[..., None])
    alphas = torch.stack(alphas)
    return expected_depth(torch.stack(images), alphas, o.render_mode), alphas, {"depths": depths}
