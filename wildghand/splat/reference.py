"""The rasterizer in plain PyTorch, brute force: the truth that the tests compare with.

Every pixel looks at every Gaussian, so it is for tiny scenes. It takes any floating dtype and
its gradients are PyTorch's own.
"""

from __future__ import annotations

from typing import Any

import torch

from wildghand.splat import conventions as rules
from wildghand.splat.scene import (
    FlatScene,
    Options,
    channels_with_depth,
    expected_depth,
    good_backgrounds,
    per_image,
    unflattened,
    usable,
)

#: Elements of a (pixels, Gaussians) matrix that are worked on at a time.
CHUNK = 1 << 22


def rasterize_reference(scene: FlatScene) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Draws the scene; see `wildghand.splat.rasterize` for shapes and units.

    Returns:
        channels (I, H, W, X), alphas (I, H, W, 1) and the backend's part of `info`.

    Source: Kerbl et al. 2023, equations 3-6; Zwicker et al. 2001 for the projection; order and
    limits as in gsplat (see `conventions`).
    """
    options, images = scene.options, scene.images
    most = torch.finfo(scene.means.dtype).max
    gaussians, cameras = usable(scene, most, (0.0, most))
    masks = torch.stack([per_image(mask, images) for mask in gaussians.values()])
    keep = masks.all(0) & cameras[:, None]
    whole: dict[str, list[torch.Tensor]] = {}
    indices = []
    for i in range(images):
        index = keep[i].nonzero().squeeze(-1)
        with torch.no_grad():
            seen = _project_some(scene, i, index)["seen"]
        # Once more without those that are not seen: zero times an infinite slope is NaN.
        index = index[seen]
        indices.append(index)
        for name, value in _project_some(scene, i, index).items():
            empty = value.new_zeros(scene.gaussians, *value.shape[1:])
            whole.setdefault(name, []).append(empty.index_copy(0, index, value))
    flat = {name: torch.stack(values) for name, values in whole.items()}
    info: dict[str, Any] = {
        "means2d": unflattened(flat["means2d"], scene),
        "depths": unflattened(flat["depths"], scene),
        "radii": unflattened(flat["radii"], scene),
        "visible": unflattened(flat["radii"].new_tensor([len(i) for i in indices]).long(), scene),
    }
    flat["means2d"] = info["means2d"].reshape(flat["means2d"].shape)
    channels, backgrounds = channels_with_depth(scene.colors, flat["depths"], scene)
    channels = per_image(channels, images)
    if backgrounds is None:
        backgrounds = channels.new_zeros(images, channels.shape[-1])
    backgrounds = torch.where(good_backgrounds(backgrounds), backgrounds, 0.0)
    drawn = [
        blend(
            flat["means2d"][i][index],
            flat["conics"][i][index],
            flat["depths"][i][index],
            flat["opacities"][i][index],
            channels[i][index],
            backgrounds[i],
            options,
        )
        for i, index in enumerate(indices)
    ]
    image, alpha, pairs, margin = (torch.stack(parts) for parts in zip(*drawn, strict=True))
    info["margin"] = unflattened(margin, scene)
    if options.count_pairs:
        info["pairs"] = unflattened(pairs, scene)
    return expected_depth(image, alpha, options.render_mode), alpha, info


def _project_some(scene: FlatScene, image: int, index: torch.Tensor) -> dict[str, torch.Tensor]:
    means, quats, scales, opacities = (
        per_image(tensor, scene.images)[image][index]
        for tensor in (scene.means, scene.quats, scene.scales, scene.opacities)
    )
    return project(
        means, quats, scales, opacities, scene.viewmats[image], scene.Ks[image], scene.options
    )


def rotation(quats: torch.Tensor) -> torch.Tensor:
    """Rotation matrices (..., 3, 3) from quaternions (..., 4), wxyz, any norm but 0."""
    quats = quats / quats.detach().abs().amax(-1, keepdim=True)  # squares of tiny ones vanish
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, -1).reshape(*quats.shape[:-1], 3, 3)


def project(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    viewmat: torch.Tensor,
    K: torch.Tensor,
    options: Options,
) -> dict[str, torch.Tensor]:
    """Gaussians on the image plane of one camera.

    Returns:
        `means2d` (N, 2) px, `depths` (N,), `conics` (N, 3): the inverse covariance as
        (1 / variance along a pixel row, shear of the rows, 1 / variance across the rows), so
        that the exponent is -1/2 (a (dx + s dy)^2 + c dy^2); `opacities` (N,) as blended;
        `radii` (N, 2) px, half the size of the visible part; `seen` (N,) bool.

    The determinant is that of a Gram matrix, written as a sum of squares: the plain A C - B^2
    loses every digit for a needle.
    """
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    in_camera = means @ R.T + t
    depth = in_camera[:, 2]
    seen = (depth.detach() > options.near_plane) & (depth.detach() < options.far_plane)
    x, y, z = torch.where(seen[:, None], in_camera, torch.ones_like(in_camera)).unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    width, height, margin = options.width, options.height, rules.FRUSTUM_MARGIN
    tan_x = (x / z).clamp(-(cx + margin * width) / fx, (width - cx + margin * width) / fx)
    tan_y = (y / z).clamp(-(cy + margin * height) / fy, (height - cy + margin * height) / fy)
    zero = torch.zeros_like(z)
    J = torch.stack((fx / z, zero, -fx / z * tan_x, zero, fy / z, -fy / z * tan_y), -1)
    U = J.reshape(-1, 2, 3) @ R @ (rotation(quats) * scales[:, None, :])
    u, v = U.unbind(1)
    eps = options.eps2d
    trace_x, trace_y = (u * u).sum(-1), (v * v).sum(-1)
    area = torch.linalg.cross(u, v).square().sum(-1)
    A, B, C = trace_x + eps, (u * v).sum(-1), trace_y + eps
    det = area + eps * (trace_x + trace_y) + eps * eps
    conics = torch.stack((C / det, -B / C, 1 / C), -1)
    means2d = torch.stack((fx * x / z + cx, fy * y / z + cy), -1)
    if options.antialiased:
        # The square root of zero has no derivative; a splat without area is not seen.
        flat = area <= 0
        opacities = opacities * torch.where(flat, area, (torch.where(flat, det, area) / det).sqrt())
    with torch.no_grad():
        reach = 2 * (opacities / rules.MIN_ALPHA).log()
        extent = (reach[:, None] * torch.stack((A, C), -1)).sqrt()
        size = means2d.new_tensor([options.width, options.height])
        seen = seen & (det > 0) & (opacities >= rules.MIN_ALPHA) & conics.isfinite().all(-1)
        seen &= (extent < rules.MAX_REACH).all(-1) & (conics[:, 0] < rules.MAX_PRECISION)
        seen &= ((means2d + extent >= 0.5) & (means2d - extent <= size - 0.5)).all(-1)
        radii = extent.nan_to_num(0).ceil().clamp_max(2.0**30).to(torch.int32)
    return {
        "means2d": means2d,
        "depths": z,
        "conics": conics,
        "opacities": opacities,
        "radii": radii,
        "seen": seen,
    }


def blend(
    means2d: torch.Tensor,
    conics: torch.Tensor,
    depths: torch.Tensor,
    opacities: torch.Tensor,
    channels: torch.Tensor,
    background: torch.Tensor,
    options: Options,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Front-to-back blending of one image.

    Returns:
        (H, W, X); alpha (H, W, 1); blended pairs (); and, (H, W), how near a pixel comes to one of
        the limits in `conventions`, as the least |log ratio|: below 1e-5, float32 may decide
        otherwise.
    The order is that of float32 depth, ties by index, as every backend sorts.
    """
    order = torch.argsort(depths.detach().to(torch.float32), stable=True)
    means2d, conics, opacities = means2d[order], conics[order], opacities[order]
    channels = channels[order]
    kind = means2d.dtype
    rows = torch.arange(options.height, dtype=kind, device=means2d.device) + 0.5
    columns = torch.arange(options.width, dtype=kind, device=means2d.device) + 0.5
    pixels = torch.cartesian_prod(rows, columns).flip(-1)
    image, remaining, margin = [], [], []
    pairs = torch.zeros((), dtype=torch.int64)
    for some in pixels.split(max(1, CHUNK // max(1, len(means2d)))):
        dx, dy = (some[:, None] - means2d).unbind(-1)
        a, shear, c = conics.unbind(-1)
        power = -0.5 * (a * (dx + shear * dy) ** 2 + c * dy * dy)
        raw = opacities * power.exp()
        alpha = raw.clamp_max(rules.MAX_ALPHA)
        alpha = torch.where(alpha >= rules.MIN_ALPHA, alpha, torch.zeros_like(alpha))
        after = torch.cumprod(1 - alpha.detach(), 1)
        alpha = torch.where(after > rules.MIN_TRANSMITTANCE, alpha, torch.zeros_like(alpha))
        pairs += (alpha > 0).sum().cpu()
        margin.append(_margin(raw.detach(), after))
        after = torch.cumprod(1 - alpha, 1)
        before = torch.cat((after.new_ones(len(after), 1), after), 1)
        image.append((alpha * before[:, :-1]) @ channels + before[:, -1:] * background)
        remaining.append(before[:, -1])
    shape = (options.height, options.width)
    return (
        torch.cat(image).reshape(*shape, -1),
        1 - torch.cat(remaining).reshape(*shape, 1),
        pairs,
        torch.cat(margin).reshape(shape),
    )


def _margin(alpha: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
    """How near each pixel comes to a decision, as the least |log ratio| to a limit. (P,)."""
    limits = ((alpha, rules.MIN_ALPHA), (alpha, rules.MAX_ALPHA), (after, rules.MIN_TRANSMITTANCE))
    least = alpha.new_full(alpha.shape[:1], torch.inf)
    if alpha.shape[1]:
        for value, limit in limits:
            least = torch.minimum(least, (value / limit).log().abs().amin(1))
    return least
