"""What keeps Gaussians even and closed over the skin: a Laplacian, and flat opaque discs.

A picture says nothing of the side of the hand that it does not show, nor how far a Gaussian that
faces the camera reaches along the line of sight, nor whether the one behind it is there at all.
What no frame contradicts should look like skin from everywhere: no holes and no fur.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import types
from torch import Tensor, relu, stack
from torch.nn.functional import normalize

from hwp_bench.base.errors import ShapeMismatch
from hwp_bench.base.kernels import compiled
from hwp_bench.base.numerics import kd_tree
from hwp_bench.hands.anchors import anchor_frames, anchor_positions
from wildghand.gaussians.attributes import CHANNELS, SIZES, Activation, RawAttributes
from wildghand.gaussians.rig import HandRig
from wildghand.splat.kernels.jit import next_job
from wildghand.splat.kernels.vectors import Vector, make_fill, make_load, store
from wildghand.splat.threads import kernels_take, lease, piece_count, run_pieces

#: Rows that one thread takes at a time.
ROWS = 512
#: Channels that are summed together.
_LANES = 16

_FLOATS = Vector(types.float32, _LANES)
_load = make_load(_FLOATS)
_fill = make_fill(_FLOATS)


@compiled(nogil=True)
def bags_kernel(worker, counters, ends, values, index, weight, start, out):
    """See `sum_bags`; a job is `ROWS` rows."""
    rows, channels = out.shape
    room = np.zeros(_LANES, np.float32)
    job = next_job(worker, counters, ends)
    while job >= 0:
        for row in range(ROWS * job, min(ROWS * (job + 1), rows)):
            first, last = start[row], start[row + 1] if row + 1 < rows else len(index)
            if channels < _LANES:
                sums = _fill(np.float32(0.0))
                for term in range(first, last):
                    at = index[term] * channels
                    if at + _LANES <= values.size:
                        sums = sums + _load(values, at) * weight[term]
                    else:  # nothing behind the last row is read
                        for c in range(channels):
                            room[c] = values[index[term], c]
                        sums = sums + _load(room, 0) * weight[term]
                store(room, 0, sums)
                for c in range(channels):
                    out[row, c] = room[c]
                continue
            for place in range(0, channels, _LANES):
                # The last vector begins where it ends with the row.
                c = min(place, channels - _LANES)
                sums = _fill(np.float32(0.0))
                for term in range(first, last):
                    sums = sums + _load(values, index[term] * channels + c) * weight[term]
                store(out, row * channels + c, sums)
        job = next_job(worker, counters, ends)


def sum_bags(values: Tensor, index: Tensor, weight: Tensor, start: Tensor) -> Tensor:
    """Row i sums the terms start[i] to start[i + 1], the last one to the end; no gradient.

    A term is row `index` (K,) of `values` (inputs, C), times `weight` (K,); `start` is (outputs,).
    Torch's `embedding_bag` does the same, and takes three times as long where most bags are empty.
    """
    # Memory that was used before: fresh memory costs as much as the sums.
    out = torch.from_numpy(lease((len(start), values.shape[1]), np.float32))
    run_pieces(
        bags_kernel,
        len(start),
        ROWS,
        len(index) + len(start),
        *(tensor.detach().contiguous().numpy() for tensor in (values, index, weight, start)),
        out.numpy(),
    )
    return out


#: Neighbours of each anchor.
NEIGHBOURS = 6
# Candidates for each neighbour: some lie on the other side of a finger.
_CANDIDATES = 3


@dataclass(frozen=True, eq=False)
class SurfaceLaplacian:
    """Value minus the mean of its neighbours, for N anchors."""

    #: (N, N) sparse CSR.
    matrix: Tensor
    #: (N, N) sparse CSR, its transpose, for the gradient.
    transposed: Tensor
    #: (N, 3, 3) anchor frames on the rest surface.
    frames: Tensor
    #: Mean distance between neighbouring anchors, m.
    spacing: float

    def __call__(self, values: Tensor) -> Tensor:
        """Differences of (..., N, C) to the neighbours' mean, in the matrix's type."""
        count = len(self.matrix)
        if values.ndim < 2 or values.shape[-2] != count:
            raise ShapeMismatch(
                f"has shape {tuple(values.shape)}, expected (..., {count}, C)", field="values"
            )
        rows = values.movedim(-2, 0).reshape(count, -1).to(self.matrix.dtype)
        made = _Product.apply(rows, self.matrix, self.transposed)
        return made.reshape(count, *values.shape[:-2], values.shape[-1]).movedim(0, -2)

    def roughness(self, values: Tensor) -> Tensor:
        """Mean over anchors (and frames) of the squared length of the difference."""
        return self(values).square().sum(dim=-1).mean()

    def offsets(self, offsets: Tensor) -> Tensor:
        """Roughness of displacements (..., N, 3) m in the anchors' frames.

        They are compared in the axes of the rest pose and in units of the spacing: the tangents of
        neighbouring anchor frames may point anywhere.
        """
        turned = (self.frames.to(offsets) @ offsets.unsqueeze(-1)).squeeze(-1)
        return self.roughness(turned / self.spacing)


def surface_laplacian(
    rig: HandRig, neighbours: int = NEIGHBOURS, dtype: torch.dtype = torch.float32
) -> SurfaceLaplacian:
    """Connect each anchor of a hand with its nearest neighbours on the rest surface.

    Neighbours are nearest in space among those whose normals agree, so that neither the two
    sides of a finger nor two fingers that touch are connected. All weigh the same.

    Args:
        rig: the hand and its anchors.
        neighbours: of each anchor; fewer where there are fewer anchors.
        dtype: of the values that will be given.
    """
    frames = anchor_frames(rig.template.vertices, rig.template.faces, rig.anchors)
    matrix = _difference_matrix(nearest_on_surface(*rest_anchors(rig), neighbours))
    device = frames.device

    def sparse(scipy_matrix: Any) -> Tensor:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")
            return torch.sparse_csr_tensor(
                torch.from_numpy(scipy_matrix.indptr.astype(np.int64)),
                torch.from_numpy(scipy_matrix.indices.astype(np.int64)),
                torch.from_numpy(scipy_matrix.data).to(dtype),
                size=scipy_matrix.shape,
                device=device,
                check_invariants=True,
            )

    return SurfaceLaplacian(sparse(matrix), sparse(matrix.T.tocsr()), frames, rig.spacing)


def rest_anchors(rig: HandRig) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) positions, m, and (N, 3) unit normals of the anchors on the rest surface."""
    vertices, faces = rig.template.vertices, rig.template.faces
    positions = anchor_positions(vertices, faces, rig.anchors)
    normals = anchor_frames(vertices, faces, rig.anchors)[..., 2]
    return positions.cpu().numpy(), normals.cpu().numpy()


def nearest_on_surface(positions: np.ndarray, normals: np.ndarray, count: int) -> np.ndarray:
    """The nearest points whose normals differ by less than a right angle.

    (N, K) int64, K = count or N - 1 if that is less; -1 where fewer agree.
    """
    total = len(positions)
    found = min(count, total - 1)
    candidates = min(_CANDIDATES * count + 1, total)
    _, near = kd_tree(positions).query(positions, k=candidates)
    near = near.reshape(total, candidates)
    agree = np.einsum("nc,nkc->nk", normals, normals[near]) > 0.0
    agree &= near != np.arange(total)[:, None]
    order = np.argsort(~agree, axis=1, kind="stable")[:, :found]
    chosen = np.take_along_axis(near, order, axis=1)
    return np.where(np.take_along_axis(agree, order, axis=1), chosen, -1)


def _difference_matrix(near: np.ndarray) -> Any:
    """Identity minus the neighbours' mean; a row without neighbours is zero."""
    from scipy.sparse import csr_array

    total = len(near)
    counts = (near >= 0).sum(axis=1)
    rows, places = np.nonzero(near >= 0)
    own = np.where(counts > 0, 1.0, 0.0)
    data = np.concatenate([own, -1.0 / counts[rows]])
    index = (
        np.concatenate([np.arange(total), rows]),
        np.concatenate([np.arange(total), near[rows, places]]),
    )
    return csr_array((data, index), shape=(total, total))


class _Product(torch.autograd.Function):
    """Sparse times dense; torch's own gradient would build the transpose at every step."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, matrix: Tensor, transposed: Tensor) -> Tensor:
        ctx.save_for_backward(transposed)
        return sparse_times(matrix, values)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (transposed,) = ctx.saved_tensors
        return sparse_times(transposed, gradient), None, None


def sparse_times(matrix: Tensor, rows: Tensor) -> Tensor:
    """Product of a sparse CSR matrix and rows (N, C) of the same type; no gradient on the CPU."""
    if kernels_take(rows):
        starts = matrix.crow_indices()[:-1]
        return sum_bags(rows, matrix.col_indices(), matrix.values(), starts)
    return matrix @ rows


_NAMES = list(SIZES)
_STARTS = {name: sum(SIZES[other] for other in _NAMES[:i]) for i, name in enumerate(_NAMES)}


def attribute_roughness(
    laplacian: SurfaceLaplacian, raw: Tensor, scales: float, colors: float
) -> Tensor:
    """`SurfaceLaplacian.roughness` of the log scales and colours in (B, N, 14) raw attributes.

    Its gradient is by hand: autograd would join that of six channels from all fourteen.
    """
    return _Roughness.apply(raw, laplacian.matrix, laplacian.transposed, scales, colors)


class _Roughness(torch.autograd.Function):
    """One product with the Laplacian forward, one with its transpose backward."""

    @staticmethod
    def forward(
        ctx: Any, raw: Tensor, matrix: Tensor, transposed: Tensor, scales: float, colors: float
    ) -> Tensor:
        frames, count = raw.shape[:2]
        parts = [_part(raw, "log_scales"), _part(raw, "logit_colors").sigmoid()]
        ctx.factors = math.sqrt(scales), math.sqrt(colors)
        values = torch.cat([p * f for p, f in zip(parts, ctx.factors, strict=True)], dim=-1)
        rows = values.movedim(1, 0).reshape(count, -1).to(matrix.dtype)
        differences = sparse_times(matrix, rows)
        ctx.save_for_backward(differences, parts[1], transposed)
        return differences.square().sum() / max(1, frames * count)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        differences, colors, transposed = ctx.saved_tensors
        frames, count = colors.shape[:2]
        scale = gradient * (2.0 / max(1, frames * count))
        back = sparse_times(transposed, differences).view(count, frames, -1).movedim(0, 1)
        back = (back * scale).to(colors.dtype)
        of_raw = colors.new_zeros(frames, count, CHANNELS)
        wide = SIZES["log_scales"]
        torch.mul(back[..., :wide], ctx.factors[0], out=_part(of_raw, "log_scales"))
        slope = colors * (1.0 - colors) * ctx.factors[1]
        torch.mul(back[..., wide:], slope, out=_part(of_raw, "logit_colors"))
        return of_raw, None, None, None, None


def _part(raw: Tensor, name: str) -> Tensor:
    return raw.narrow(-1, _STARTS[name], SIZES[name])


#: Gaussians that one thread takes at a time.
PIECE = 512
_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_FOUR = np.float32(4.0)


@compiled(nogil=True)
def off_surface_kernel(worker, counters, ends, raw, lengths, log_scales, free, tiny, made, costs):
    """Cost of the Gaussians of all frames, and its gradient.

    Args:
        raw: (B N, 14) float32.
        lengths: (2,) float32 m: largest displacement, and spacing of the anchors.
        log_scales: (3,) float32: bias, least and greatest of the log scales.
        free: (8,) float32 what costs nothing: reach, shift, logarithm of the least width, greatest
            width, opacity; the weight of the opacity; the thickness that costs nothing, and the
            weight of the thickness.
        tiny: float32 below which squares of lengths have no slope.
        made: (B N, 14) float32, filled: gradient of the sum of all costs.
    """
    count = len(raw)
    reach, aside, narrow, wide = free[0], free[1], free[2], free[3]
    bound = lengths[0] / lengths[1]
    squares, moved = np.empty(3, np.float32), np.empty(3, np.float32)
    first, second = np.empty(3, np.float32), np.empty(3, np.float32)
    of_first, of_second = np.empty(3, np.float32), np.empty(3, np.float32)
    job = next_job(worker, counters, ends)
    while job >= 0:
        total = 0.0
        for n in range(PIECE * job, min(PIECE * (job + 1), count)):
            given, found = raw[n], made[n]
            for i in range(3):
                moved[i] = np.float32(math.tanh(_HALF * given[i]))
                value = min(max(given[3 + i] + log_scales[0], log_scales[1]), log_scales[2])
                squares[i] = (np.float32(math.exp(value)) / lengths[1]) ** 2
            # As torch's normalize: the length is at least 1e-12.
            w, x, y, z = given[6], given[7], given[8], given[9]
            inverse = _ONE / max(np.sqrt(w * w + x * x + y * y + z * z), np.float32(1e-12))
            w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
            first[0] = _ONE - _TWO * (y * y + z * z)
            first[1] = _TWO * (x * y - w * z)
            first[2] = _TWO * (x * z + w * y)
            second[0] = _TWO * (x * y + w * z)
            second[1] = _ONE - _TWO * (x * x + z * z)
            second[2] = _TWO * (y * z - w * x)
            xx, yy, xy, trace = _ZERO, _ZERO, _ZERO, _ZERO
            for i in range(3):
                xx += squares[i] * first[i] * first[i]
                yy += squares[i] * second[i] * second[i]
                xy += squares[i] * first[i] * second[i]
                trace += squares[i]
            across, along, area = xx + yy, trace - (xx + yy), xx * yy - xy * xy
            off = bound * moved[2]
            root = np.sqrt(max(along, tiny))
            reaching = max(abs(off) + _TWO * root - reach, _ZERO)
            thick = max(_TWO * root - free[6], _ZERO)
            right, up = bound * moved[0], bound * moved[1]
            distance = np.sqrt(right * right + up * up + tiny)
            shifted = max(distance - aside, _ZERO)
            width = np.sqrt(across + tiny)
            too_narrow = max(narrow - _HALF * _HALF * np.float32(math.log(max(area, tiny))), _ZERO)
            too_wide = max(width - wide, _ZERO)
            opacity = _ONE / (_ONE + np.float32(math.exp(-given[10])))
            clear = max(free[4] - opacity, _ZERO)
            total += reaching * reaching + shifted * shifted + too_narrow * too_narrow
            total += too_wide * too_wide + free[5] * clear * clear + free[7] * thick * thick
            # The gradient, from the costs back to the channels.
            of_along = _TWO * (reaching + free[7] * thick) / root if along >= tiny else _ZERO
            of_area = -_HALF * too_narrow / area if area >= tiny else _ZERO
            of_across = too_wide / width - of_along
            of_xx, of_yy = of_area * yy + of_across, of_area * xx + of_across
            of_xy = -_TWO * xy * of_area
            for i in range(3):
                q, a, b = squares[i], first[i], second[i]
                of_square = of_along + of_xx * a * a + of_yy * b * b + of_xy * a * b
                value = given[3 + i] + log_scales[0]
                inside = log_scales[1] <= value and value <= log_scales[2]
                found[3 + i] = _TWO * q * of_square if inside else _ZERO
                of_first[i] = q * (_TWO * of_xx * a + of_xy * b)
                of_second[i] = q * (_TWO * of_yy * b + of_xy * a)
            a, b, c = of_first[0], of_first[1], of_first[2]
            d, e, f = of_second[0], of_second[1], of_second[2]
            of_w = _TWO * (y * c - z * b + z * d - x * f)
            of_x = _TWO * (y * b + z * c + y * d - w * f) - _FOUR * x * e
            of_y = _TWO * (x * b + w * c + x * d + z * f) - _FOUR * y * a
            of_z = _TWO * (x * c - w * b + w * d + y * f) - _FOUR * z * (a + e)
            radial = w * of_w + x * of_x + y * of_y + z * of_z
            found[6] = inverse * (of_w - radial * w)
            found[7] = inverse * (of_x - radial * x)
            found[8] = inverse * (of_y - radial * y)
            found[9] = inverse * (of_z - radial * z)
            sideways = _TWO * shifted / distance
            found[0] = sideways * right * _HALF * bound * (_ONE - moved[0] * moved[0])
            found[1] = sideways * up * _HALF * bound * (_ONE - moved[1] * moved[1])
            sign = _ZERO if off == _ZERO else (_ONE if off > _ZERO else -_ONE)
            found[2] = _TWO * reaching * sign * _HALF * bound * (_ONE - moved[2] * moved[2])
            found[10] = -_TWO * free[5] * clear * opacity * (_ONE - opacity)
            for i in range(11, 14):
                found[i] = _ZERO
        costs[job] = total
        job = next_job(worker, counters, ends)


#: A Gaussian here takes as long as so many of those that `thread_count` counts.
_WEIGHT = 2


class OffSurfaceCpu(torch.autograd.Function):
    """Sum of the costs over all Gaussians, divided by their number."""

    @staticmethod
    def forward(
        ctx: Any,
        raw: Tensor,
        activation: Activation,
        spacing: float,
        free: tuple[float, ...],
        tiny: float,
    ) -> Tensor:
        """Return the mean cost of (..., N, 14) raw attributes; `free` as the kernel takes it."""
        given = raw.detach().contiguous().view(-1, CHANNELS)
        made, count = torch.empty_like(given), len(given)
        costs = np.zeros(piece_count(count, PIECE))
        least, greatest = math.log(activation.min_scale), math.log(activation.max_scale)
        run_pieces(
            off_surface_kernel,
            count,
            PIECE,
            _WEIGHT * count,
            given.numpy(),
            np.array([activation.max_offset, spacing], np.float32),
            np.array([activation.log_scale_bias, least, greatest], np.float32),
            np.array(free, np.float32),
            np.float32(tiny),
            made.numpy(),
            costs,
        )
        ctx.save_for_backward(made)
        ctx.shape = raw.shape
        return raw.new_tensor(costs.sum() / count)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Gradient of the raw attributes."""
        (made,) = ctx.saved_tensors
        return (made * (gradient / len(made))).view(ctx.shape), None, None, None, None


# What costs nothing. Lengths in spacings of the anchors: how far a Gaussian reaches off the skin
# (its distance and two standard deviations), how far it lies from its anchor along the skin, its
# least and largest standard deviation along the skin; and its opacity. Two standard deviations off
# the skin, where thickness costs.
_REACH, _SHIFT, _NARROW, _WIDE, _OPAQUE, _THICK = 0.8, 0.5, 0.6, 1.5, 0.98, 0.4
# Weight of the opacity: a hole in spacings.
_HOLE = 4.0
# Squares of lengths below this have no slope, in spacings.
_TINY = 1e-8


def off_surface(
    raw: RawAttributes, activation: Activation, spacing: float, *, flatness: float = 0.0
) -> Tensor:
    """Mean over Gaussians and frames of what keeps them from closing the surface.

    Args:
        raw: (B, N, k) attributes.
        spacing: mean distance between neighbouring anchors, m.
    """
    if kernels_take(*(tensor for _, tensor in raw.items())):
        free = (_REACH, _SHIFT, math.log(_NARROW), _WIDE, _OPAQUE, _HOLE, _THICK, flatness)
        return OffSurfaceCpu.apply(raw.concatenate(), activation, spacing, free, _TINY)
    rows = _tangents(raw.quats)
    drawn = activation(raw)
    squares = (drawn.scales / spacing).square()
    xx, yy, xy = ((squares * rows[i] * rows[j]).sum(dim=-1) for i, j in ((0, 0), (1, 1), (0, 1)))
    across = xx + yy
    # The trace does not change when a Gaussian turns.
    along = (squares.sum(dim=-1) - across).clamp(min=_TINY)
    area = (xx * yy - xy * xy).clamp(min=_TINY)
    offsets = drawn.offsets / spacing
    shift = (offsets[..., :2].square().sum(dim=-1) + _TINY).sqrt()
    thickness = 2.0 * along.sqrt()
    cost = relu(offsets[..., 2].abs() + thickness - _REACH).square()
    cost = cost + flatness * relu(thickness - _THICK).square()
    cost = cost + relu(shift - _SHIFT).square()
    cost = cost + relu(math.log(_NARROW) - 0.25 * area.log()).square()
    cost = cost + relu((across + _TINY).sqrt() - _WIDE).square()
    cost = cost + _HOLE * relu(_OPAQUE - drawn.opacities).square()
    return cost.mean()


def _tangents(quats: Tensor) -> tuple[Tensor, Tensor]:
    """The two rows (..., 3) of a Gaussian's rotation that lie in the skin; any length but 0."""
    w, x, y, z = normalize(quats, dim=-1).unbind(-1)
    first = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y))
    second = (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x))
    return stack(first, dim=-1), stack(second, dim=-1)
