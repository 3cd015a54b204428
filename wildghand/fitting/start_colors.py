"""Colours that no skin has, read from the frames before the first step.

The prior knows skin. From there it takes hundreds of steps to the palm of a green glove that few
frames show, and a short fit ends on the way. So where the frames show a tint that is far from what
the network says, the identity map starts from theirs. Differences in brightness are left alone:
they are light too, which the network has to tell from colour.
"""

from __future__ import annotations

import torch
from torch import Tensor

from wildghand.evidence.count import read_images, seen_anchors
from wildghand.fitting.cast_shadows import Dark
from wildghand.fitting.chosen_frames import best_of_each_part
from wildghand.fitting.weighting import Weighting
from wildghand.gaussians.attributes import CHANNELS, SIZES
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.training import TrainingClip, TrainingFrames
from wildghand.model.model import WildGHandModel
from wildghand.network.surface import Chart, PlaneSampler

#: Frames that are read, spread over the clip: of each part the one that the pre-pass weighs most.
FRAMES = 16
#: Distance of the tint from the network's, in logits of sRGB, at which the frames' colour begins to
#: count, and at which it counts fully.
FROM, FULL = 0.3, 0.5
# Corrections of the map one after the other, and the share of the difference that each takes.
_ROUNDS, _SHARE = 3, 0.8
# Views that the network's colour is worth.
_VIEWS = 0.5
# Weight of a cell of the map below which it keeps what it has.
_CELL = 0.02
# sRGB nearer to 0 or 1 says nothing in logits; nor do larger differences.
_DARKEST, _FARTHEST = 0.01, 3.0
_COLORS = slice(CHANNELS - SIZES["logit_colors"], CHANNELS)


@torch.no_grad()
def start_from_colors(
    model: WildGHandModel,
    clip: TrainingClip,
    frames: TrainingFrames,
    weighting: Weighting,
    dark: Dark,
) -> None:
    """Move the identity map to the frames' colours where their tint is far from the network's.

    Nothing is random. A network without a direct path from map to attributes stays as it is.

    Args:
        model: its map is changed.
        clip: hands and cameras of the frames.
        frames: that are fitted.
        weighting: how much each pixel says of the hand.
        dark: the shadows in the frames; they and the light are taken out of the colours.
    """
    direct = model.network.attribute_head.direct
    if direct is None:
        return
    rows = best_of_each_part(weighting.frame_weights, FRAMES)
    says = weighting.visible(rows)
    images = frames.images[rows].to(says.device).float() / 255.0
    here = rows.to(says.device)
    hands = {side: clip.hand(side, here) for side in model.rigs}
    seen = seen_anchors(hands, clip.viewmats[here], clip.Ks[here], says.shape[1:])
    shadows = dark(rows)
    to_map = torch.linalg.pinv(direct.weight[_COLORS, _COLORS])
    for side, (pixels, facing) in seen.items():
        views = read_images(says, pixels) * facing
        shown = [read_images(images[..., channel].contiguous(), pixels) for channel in range(3)]
        normals, poses = quat_third_axis(hands[side].orientations), clip.parameters[side][0][here]
        wanted = _logits(torch.stack(shown, dim=-1) / _lit(model, normals, shadows.get(side)))
        chart = model.network.charts[side]
        assert isinstance(chart, Chart)
        share = None
        for _ in range(_ROUNDS):
            made = model.network(side, normals, poses)
            drawn = _logits(made.raw.logit_colors.sigmoid() * made.shadow)
            off = _mean((wanted - drawn).clamp(-_FARTHEST, _FARTHEST), views)
            share = tint_share(off) if share is None else share
            trust = views.sum(dim=0) / (views.sum(dim=0) + _VIEWS)
            change = share * off @ to_map.mT
            step = _spread(
                chart.identity, torch.cat((change, torch.ones_like(share)), dim=1), trust
            )
            model.network.identity.maps[side][:, _COLORS] += _SHARE * step


def tint_share(off: Tensor) -> Tensor:
    """(N, 1) in [0, 1], how far colours that differ by (N, 3) are not skin: by their tint alone."""
    tint = (off - off.mean(dim=-1, keepdim=True)).norm(dim=-1, keepdim=True)
    return ((tint - FROM) / (FULL - FROM)).clamp(0.0, 1.0)


def _lit(model: WildGHandModel, normals: Tensor, dark: Tensor | None) -> Tensor:
    """(B, N, 1) factors of light and shadows on colours of (B, N) places."""
    lit = torch.ones_like(normals[..., 0]) if dark is None else dark
    shading = None if model.shadows is None else model.shadows.shading(normals)
    return (lit if shading is None else lit * shading)[..., None]


def _logits(colors: Tensor) -> Tensor:
    return torch.logit(colors.clamp(_DARKEST, 1.0 - _DARKEST))


def _mean(values: Tensor, weights: Tensor) -> Tensor:
    """(N, C) mean over B frames of (B, N, C), weighted by (B, N); 0 without any weight."""
    sums = (weights[..., None] * values).sum(dim=0)
    return sums / weights.sum(dim=0).clamp(min=1e-6)[:, None]


def _spread(sampler: PlaneSampler, values: Tensor, weights: Tensor) -> Tensor:
    """(cells, C) weighted means in the cells of a plane of what Gaussians ask of it.

    Args:
        sampler: reads the plane at N places.
        values: (N, C + 1), the last one 1.
        weights: (N,) in [0, 1].
    """
    asked = sampler.transposed(values * weights[:, None])
    return asked[:, :-1] / (asked[:, -1:] + _CELL)
