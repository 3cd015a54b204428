"""What `compact` does for every frame, as one function with a gradient written by hand.

It computes what `CompactGeometry` and the heads (i), (ii) compute, with the same parameters, in
some twenty products of matrices in place of a hundred operations of autograd, which cost more than
their arithmetic.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import silu

from wildghand.gaussians.attributes import CHANNELS
from wildghand.gaussians.shading import sh_basis
from wildghand.network.branches import CompactGeometry
from wildghand.network.heads import AttributeHead, ShadowHead
from wildghand.network.surface import COORDINATES, encode_pose

#: Attributes and the logit of the shadow coefficient, and zeros up to a multiple of 16.
_OUTPUTS = 16


def frame_heads(
    branch: CompactGeometry,
    attributes: AttributeHead,
    shadow: ShadowHead,
    *,
    coordinates: Tensor,
    normals: Tensor,
    pose: Tensor,
    hidden: Tensor,
    latent: Tensor,
    initial: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Heads (i) and (ii) on the geometry features of N Gaussians in B frames.

    Args:
        branch, attributes, shadow: whose parameters are used; the heads have one hidden layer.
        coordinates: (N, 20) of the chart, without gradient.
        normals: (B, N, 3) float32 of length 1, world, without gradient.
        pose: (B, 16, 3) axis-angle, rad.
        hidden: (N, width) of head (i), from the texture features.
        latent: (N, I) identity features, of which head (i) adds a linear map if it is `direct`.
        initial: (N, 14) raw attributes to which all of this is added, without gradient.

    Returns:
        (B, N, 14) raw attributes, (B, N, 1) shadow coefficients, and (B, L + width) mean of the
        geometry features, L harmonics first.
    """
    geometry, detail, last = attributes.geometry[0], shadow.detail[0], shadow.detail[2]
    weights = (
        branch.place.weight,
        branch.normal.weight,
        branch.mix.weight,
        branch.mix.bias,
        geometry.weight,
        detail.weight,
        geometry.bias,
        detail.bias,
        attributes.attributes.weight,
        last.weight,
        attributes.attributes.bias,
        last.bias,
        shadow.light.weight,
        attributes.direct_weight(),
    )
    encoded = encode_pose(pose, branch.frequencies)
    raw, logit, mean = _FrameHeads.apply(
        _points(branch, coordinates, normals),
        branch.pose(encoded) + branch.place.bias,
        hidden,
        latent,
        initial,
        *weights,
    )
    return raw, shadow.activate(logit), mean


def _points(branch: CompactGeometry, coordinates: Tensor, normals: Tensor) -> Tensor:
    """(B, N, C + L + H): place and harmonics, and room for what is made of them."""
    batch, count = normals.shape[:2]
    harmonics, width = branch.normal.in_features, branch.mix.out_features
    points = normals.new_empty(batch, count, COORDINATES + harmonics + width)
    points[..., :COORDINATES] = coordinates
    points[..., COORDINATES : COORDINATES + harmonics] = sh_basis(normals, branch.degree)[..., 1:]
    return points


class _FrameHeads(torch.autograd.Function):
    """Two layers to geometry features, two heads side by side on them.

    Arguments: points (B, N, C + L + H), of which the last H are filled here; shift (B, H) of the
    first layer; hidden (N, W); latent (N, I); initial (N, 14); then the parameters, in the order
    in which `frame_heads` gives them. Layers on the same input are joined to one.
    """

    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        shift: Tensor,
        hidden: Tensor,
        latent: Tensor,
        initial: Tensor,
        *given: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return raw attributes, logit, and mean features."""
        place, normal, second, second_bias = given[:4]
        first = torch.cat((place, normal), dim=1)
        heads, heads_bias = torch.cat(given[4:6]), torch.cat(given[6:8])
        last, last_bias = _padded(given[8], given[9], given[10], given[11], given[13])
        linear = given[12][0]
        batch, count, width = len(points), len(hidden), len(second)
        rows = points.view(batch * count, -1)
        seen, features = rows[:, : first.shape[1]], rows[:, -len(linear) :]
        first_seen = seen @ first.mT
        first_seen.view(batch, count, width).add_(shift[:, None])
        first_made = silu(first_seen)
        second_seen = torch.addmm(second_bias, first_made, second.mT)
        torch.ops.aten.silu.out(second_seen, out=features[:, -width:])
        heads_seen = torch.addmm(heads_bias, features, heads.mT)
        # The hidden layers of both heads and the identity features, side by side.
        heads_made = points.new_empty(batch * count, last.shape[1])
        torch.ops.aten.silu.out(heads_seen, out=heads_made[:, : len(heads)])
        heads_made.view(batch, count, -1)[..., : hidden.shape[1]].add_(hidden)
        heads_made.view(batch, count, -1)[..., len(heads) :] = latent
        made = torch.addmm(last_bias, heads_made, last.mT)
        made[:, CHANNELS].add_(features @ linear)
        made = made.view(batch, count, -1)
        ctx.save_for_backward(
            points, first_seen, first_made, second_seen, heads_seen, heads_made,
            first, second, heads, last, linear,
        )  # fmt: skip
        ctx.places, ctx.hidden_width = place.shape[1], hidden.shape[1]
        mean = features.view(batch, count, -1).mean(dim=1)
        return made[..., :CHANNELS] + initial, made[..., CHANNELS : CHANNELS + 1].contiguous(), mean

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        ctx: Any, of_raw: Tensor, of_logit: Tensor, of_mean: Tensor
    ) -> tuple[Tensor | None, ...]:
        """Gradients of all arguments but the points."""
        (
            points, first_seen, first_made, second_seen, heads_seen, heads_made,
            first, second, heads, last, linear,
        ) = ctx.saved_tensors  # fmt: skip
        batch, count, width = len(points), points.shape[1], len(second)
        rows = points.view(batch * count, -1)
        seen, features = rows[:, : first.shape[1]], rows[:, -len(linear) :]
        of_made = points.new_zeros(batch * count, len(last))
        of_made[:, :CHANNELS] = of_raw.reshape(batch * count, -1)
        of_made[:, CHANNELS] = of_logit.flatten()
        of_logits = of_made[:, CHANNELS]
        of_heads_made = of_made @ last
        of_hidden = of_heads_made.view(batch, count, -1)[..., : ctx.hidden_width].sum(dim=0)
        of_latent = of_heads_made.view(batch, count, -1)[..., len(heads) :].sum(dim=0)
        of_heads_seen = torch.ops.aten.silu_backward(of_heads_made[:, : len(heads)], heads_seen)
        # The geometry features are the harmonics, which nothing moves, and the second layer.
        of_second_made = of_heads_seen @ heads[:, -width:]
        of_second_made.addr_(of_logits, linear[-width:])
        of_second_made.view(batch, count, width).add_(of_mean[:, None, -width:], alpha=1.0 / count)
        of_second_seen = torch.ops.aten.silu_backward(of_second_made, second_seen)
        of_first_seen = torch.ops.aten.silu_backward(of_second_seen @ second, first_seen)
        # The wider factor last: MKL takes half as long again for the other order.
        of_first, of_last = (seen.mT @ of_first_seen).mT, of_made.mT @ heads_made
        of_heads, of_heads_bias = (features.mT @ of_heads_seen).mT, of_heads_seen.sum(dim=0)
        of_last_bias = of_made.sum(dim=0)
        cut = ctx.hidden_width
        return (
            None,
            of_first_seen.view(batch, count, width).sum(dim=1),
            of_hidden,
            of_latent,
            None,
            of_first[:, : ctx.places],
            of_first[:, ctx.places :],
            of_second_seen.mT @ first_made,
            of_second_seen.sum(dim=0),
            of_heads[:cut],
            of_heads[cut:],
            of_heads_bias[:cut],
            of_heads_bias[cut:],
            of_last[:CHANNELS, :cut],
            of_last[CHANNELS : CHANNELS + 1, cut : len(heads)],
            of_last_bias[:CHANNELS],
            of_last_bias[CHANNELS : CHANNELS + 1],
            (features.mT @ of_logits)[None],
            of_last[:CHANNELS, len(heads) :],
        )


def _padded(
    attributes: Tensor, logit: Tensor, bias: Tensor, logit_bias: Tensor, direct: Tensor
) -> tuple[Tensor, Tensor]:
    """The heads' last layers and the direct path as one layer, (16, 2 W + I) and (16,).

    The last output is always 0: products with 15 columns take almost three times as long.
    """
    first, second = attributes.shape[1], attributes.shape[1] + logit.shape[1]
    weight = attributes.new_zeros(_OUTPUTS, second + direct.shape[1])
    weight[:CHANNELS, :first] = attributes
    weight[CHANNELS, first:second] = logit[0]
    weight[:CHANNELS, second:] = direct
    rest = bias.new_zeros(_OUTPUTS - CHANNELS - 1)
    return weight, torch.cat((bias, logit_bias, rest))
