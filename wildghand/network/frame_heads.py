"""What `compact` does for every frame, as one function with a gradient written by hand.

It computes what `CompactGeometry` and the heads (i), (ii) compute, with the same parameters: on the
CPU in compiled code (`products`), elsewhere some twenty products of matrices in place of a hundred
operations of autograd, which cost more than their arithmetic.
"""

from __future__ import annotations

import functools
import itertools
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import silu

from wildghand.gaussians.attributes import CHANNELS
from wildghand.gaussians.shading import fill_harmonics, sh_basis
from wildghand.network.branches import CompactGeometry
from wildghand.network.heads import AttributeHead, ShadowHead
from wildghand.network.products import (
    LANES,
    PIECE,
    ROWS,
    Layout,
    Widths,
    heads_backward,
    heads_forward,
)
from wildghand.network.surface import COORDINATES, encode_pose
from wildghand.splat.threads import kernels_take, lease, piece_count, run_pieces

#: A Gaussian here takes as long as so many of those that `thread_count` counts.
_WEIGHT = 16


class FrameHeadsCpu(torch.autograd.Function):
    """Raw attributes (B, N, 14), shadow coefficients (B, N, 1) and mean features (B, Fg).

    Arguments: places (N, C), harmonics (B, N, L), encoded pose (B, E) and initial (N, 14), all
    without gradient; the logit that the shadow starts from; hidden (N, head), latent (N, I); the
    weights of pose (width, E) and the bias of place (width,); then the weights of the layers, in
    the order of `_views`.
    """

    @staticmethod
    def forward(
        ctx: Any,
        places: Tensor,
        harmonics: Tensor,
        encoded: Tensor,
        initial: Tensor,
        start: float,
        hidden: Tensor,
        latent: Tensor,
        of_pose: Tensor,
        bias: Tensor,
        *given: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the three."""
        frames, count = harmonics.shape[:2]
        w, layout = layout_of(
            places.shape[1], harmonics.shape[2], len(bias), hidden.shape[1], latent.shape[1]
        )
        packed = _pack(given, w, layout)
        shift = np.zeros((frames, w.point), np.float32)
        shift[:, : w.width] = torch.addmm(bias, encoded, of_pose.mT).numpy()
        inputs = [_flat(tensor) for tensor in (places, harmonics, hidden, latent)]
        seen = lease((frames * piece_count(count, ROWS) * ROWS * w.seen,), np.float32)
        raw, shadow = _room(frames, count, CHANNELS), _room(frames, count, 1)
        pieces = piece_count(count, PIECE)
        sums = np.zeros((pieces, frames, _up(w.features, LANES)), np.float32)
        _run(
            heads_forward,
            frames,
            count,
            *inputs[:2],
            shift.reshape(-1),
            *inputs[2:],
            _flat(initial),
            packed,
            w,
            layout,
            np.float32(start),
            seen,
            _flat(raw),
            _flat(shadow),
            sums.reshape(-1),
        )
        ctx.save_for_backward(encoded, shadow)
        ctx.kept = inputs, packed, w, layout, seen
        mean = sums.sum(axis=0)[:, : w.features] / np.float32(max(1, count))
        return raw, shadow, torch.from_numpy(mean)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        ctx: Any, of_raw: Tensor, of_shadow: Tensor, of_mean: Tensor
    ) -> tuple[Tensor | None, ...]:
        """Gradients of what is learnt."""
        encoded, shadow = ctx.saved_tensors
        inputs, packed, w, layout, seen = ctx.kept
        frames, count = shadow.shape[:2]
        pieces = piece_count(count, PIECE)
        mean = np.zeros((frames, w.point), np.float32)
        mean[:, : w.width] = of_mean.numpy()[:, w.harmonics :] / np.float32(max(1, count))
        of_hidden, of_latent = _room(count, w.head), _room(count, w.latent)
        of_shift = np.zeros((pieces, frames, w.point), np.float32)
        of_packed = np.zeros((pieces, layout.second_back), np.float32)
        _run(
            heads_backward,
            frames,
            count,
            *inputs,
            packed,
            w,
            layout,
            seen,
            *(_flat(tensor) for tensor in (shadow, of_raw, of_shadow)),
            mean.reshape(-1),
            _flat(of_hidden),
            _flat(of_latent),
            of_shift.reshape(-1),
            of_packed.reshape(-1),
        )
        shift = torch.from_numpy(of_shift.sum(axis=0)[:, : w.width])
        of_weights = (
            torch.from_numpy(np.ascontiguousarray(view))
            for view in _views(of_packed.sum(axis=0), w, layout)
        )
        of_bias = shift.sum(dim=0)
        return (*(None,) * 5, of_hidden, of_latent, shift.mT @ encoded, of_bias, *of_weights)


@functools.lru_cache(maxsize=8)
def layout_of(
    places: int, harmonics: int, width: int, head: int, latent: int
) -> tuple[Widths, Layout]:
    """Padded widths, and where the parts of the packed weights begin.

    Of `width` are the two layers of the geometry branch, of `head` the hidden layer of a head;
    `latent` is 0 without the direct path.
    """
    first, features = places + harmonics, harmonics + width
    point, half = _up(width, LANES), _up(head, LANES)
    heads = 2 * half
    back = heads + _up(latent, LANES)
    widths = Widths(
        places=places,
        harmonics=harmonics,
        first=first,
        features=features,
        width=width,
        point=point,
        head=head,
        half=half,
        heads=heads,
        latent=latent,
        back=back,
        row=_up(first + point, LANES),
        seen=2 * point + heads,
    )
    # Products write whole groups of rows.
    sizes = {
        "first": _up(first, ROWS) * point,
        "second": _up(width, ROWS) * point,
        "heads": _up(features, ROWS) * heads,
        "last": _up(heads + latent, ROWS) * LANES,
        "second_bias": point,
        "heads_bias": heads,
        "last_bias": LANES,
        "light": _up(features, LANES),
        "second_back": width * point,
        "heads_back": heads * point,
        "last_back": LANES * back,
        "light_back": point,
    }
    starts = np.concatenate(([0], np.cumsum(list(sizes.values())))).tolist()
    return widths, Layout(**dict(zip(sizes, starts, strict=False)), size=starts[-1])


def _views(packed: np.ndarray, w: Widths, layout: Layout) -> list[np.ndarray]:
    """The weights as torch holds them, as views of the packed ones: place, normal, mix and its
    bias, both heads and their biases, attributes, logit and their biases, light, direct."""

    def part(start: int, rows: int, columns: int) -> np.ndarray:
        return packed[start : start + rows * columns].reshape(rows, columns)

    first, second = part(layout.first, w.first, w.point), part(layout.second, w.width, w.point)
    heads = part(layout.heads, w.features, w.heads)
    last = part(layout.last, w.heads + w.latent, LANES)
    biases = packed[layout.heads_bias :], packed[layout.last_bias :]
    detail = slice(w.half, w.half + w.head)
    return [
        first[: w.places, : w.width].T,
        first[w.places :, : w.width].T,
        second[:, : w.width].T,
        packed[layout.second_bias : layout.second_bias + w.width],
        heads[:, : w.head].T,
        heads[:, detail].T,
        biases[0][: w.head],
        biases[0][detail],
        last[: w.head, :CHANNELS].T,
        last[detail, CHANNELS : CHANNELS + 1].T,
        biases[1][:CHANNELS],
        biases[1][CHANNELS : CHANNELS + 1],
        packed[None, layout.light : layout.light + w.features],
        last[w.heads :, :CHANNELS].T,
    ]


def _pack(given: tuple[Tensor, ...], w: Widths, layout: Layout) -> np.ndarray:
    """The weights where the kernels read them, and zeros where they are padded."""
    packed = np.zeros(layout.size, np.float32)
    for view, tensor in zip(_views(packed, w, layout), given, strict=True):
        view[...] = tensor.detach().numpy()
    ends = (layout.second_back, layout.heads_back, layout.last_back, layout.light_back)
    second, heads, last = (packed[start:stop] for start, stop in itertools.pairwise(ends))
    stop = layout.second + w.width * w.point
    inner = packed[layout.second : stop].reshape(w.width, w.point)
    second.reshape(w.width, w.point)[:, : w.width] = inner[:, : w.width].T
    stop = layout.heads + w.features * w.heads
    inner = packed[layout.heads : stop].reshape(w.features, w.heads)
    heads.reshape(w.heads, w.point)[:, : w.width] = inner[w.harmonics :].T
    stop = layout.last + (w.heads + w.latent) * LANES
    inner = packed[layout.last : stop].reshape(-1, LANES)
    last.reshape(LANES, w.back)[:, : w.heads + w.latent] = inner.T
    light = layout.light + w.harmonics
    packed[layout.light_back :][: w.width] = packed[light : light + w.width]
    return packed


def warm_up_heads() -> None:
    """Make the kernels ready, on one Gaussian: compiled once on a machine, loaded later."""
    zeros = torch.zeros
    shapes: tuple[tuple[int, ...], ...] = ((1, 1), (1, 1), (1, 1), (1,), (1, 2), (1, 2), (1,))
    shapes += ((1,), (14, 1), (1, 1), (14,), (1,), (1, 2), (14, 1))
    hidden = zeros(1, 1, requires_grad=True)
    given = (zeros(1, 1), zeros(1, 1, 1), zeros(1, 1), zeros(1, 14), 0.0, hidden, zeros(1, 1))
    with torch.enable_grad():
        made = FrameHeadsCpu.apply(
            *given, zeros(1, 1), zeros(1), *(zeros(*shape) for shape in shapes)
        )
        made[0].sum().backward()


def _up(number: int, step: int) -> int:
    return -(-number // step) * step


def _run(kernel: Any, frames: int, count: int, *args: Any) -> None:
    run_pieces(kernel, count, PIECE, _WEIGHT * frames * count, frames, count, *args)


def _room(*shape: int) -> Tensor:
    """Memory that was used before: fresh memory costs more than what is computed here."""
    return torch.from_numpy(lease(shape, np.float32))


def _flat(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().view(-1).numpy()


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
    if kernels_take(coordinates, normals, encoded, hidden, latent):
        light = normals.new_empty(*normals.shape[:2], branch.normal.in_features)
        fill_harmonics(normals.reshape(-1, 3), branch.degree, light.view(-1, light.shape[-1]), 0)
        return FrameHeadsCpu.apply(
            coordinates,
            light,
            encoded,
            initial,
            shadow.start,
            hidden,
            latent,
            branch.pose.weight,
            branch.place.bias,
            *weights,
        )
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
