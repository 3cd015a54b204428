"""Heads (i) and (ii) of `compact` on the CPU, float32: a compiled pass each way, on all threads."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import numpy as np
import torch
from torch import Tensor

from wildghand.network import frame_kernels as kernels
from wildghand.network.frame_kernels import CHANNELS, Layout, Widths
from wildghand.network.products import LANES, ROWS
from wildghand.splat.memory import lease
from wildghand.splat.threads import piece_count, run_pieces

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
        pieces = piece_count(count, kernels.PIECE)
        sums = np.zeros((pieces, frames, _up(w.features, LANES)), np.float32)
        _run(
            kernels.heads_forward,
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
        pieces = piece_count(count, kernels.PIECE)
        mean = np.zeros((frames, w.point), np.float32)
        mean[:, : w.width] = of_mean.numpy()[:, w.harmonics :] / np.float32(max(1, count))
        of_hidden, of_latent = _room(count, w.head), _room(count, w.latent)
        of_shift = np.zeros((pieces, frames, w.point), np.float32)
        of_packed = np.zeros((pieces, layout.second_back), np.float32)
        _run(
            kernels.heads_backward,
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

    Args:
        places: coordinates of a Gaussian.
        harmonics: of its normal.
        width: of the two layers of the geometry branch.
        head: width of the hidden layer of a head.
        latent: identity features that the direct path reads; 0 without it.
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


def warm_up() -> None:
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
    run_pieces(kernel, count, kernels.PIECE, _WEIGHT * frames * count, frames, count, *args)


def _room(*shape: int) -> Tensor:
    """Memory that was used before: fresh memory costs more than what is computed here."""
    return torch.from_numpy(lease(shape, np.float32))


def _flat(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().view(-1).numpy()
