"""The stages of the CPU backend, from arrays to arrays; each call owns what it makes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.errors import HwpError
from wildghand.splat import conventions as rules
from wildghand.splat.kernels import channels as channel_kernels
from wildghand.splat.kernels import geometry
from wildghand.splat.kernels.bins import count_tiles, fill_tiles, place_tiles
from wildghand.splat.kernels.blend import blend
from wildghand.splat.kernels.blend_backward import background_backward, blend_backward
from wildghand.splat.kernels.project import CAMERA, PIECE, project
from wildghand.splat.kernels.project_backward import project_backward
from wildghand.splat.kernels.reduce import reduce_slots
from wildghand.splat.kernels.sort import sort_by_depth
from wildghand.splat.kernels.tiles import TILE_HEIGHT, TILE_WIDTH
from wildghand.splat.memory import lease
from wildghand.splat.scene import Options
from wildghand.splat.threads import run, thread_count

#: Channels for which the blending kernels are compiled unrolled.
UNROLLED = (3,)
#: Fewest Gaussians that are worth a thread of their own while tiles are listed.
_CHUNK = 2048


@dataclass(frozen=True)
class Inputs:
    """Flat float32 arrays of one call; S entries of N Gaussians each."""

    means: np.ndarray  # (S, N, 3)
    quats: np.ndarray  # (S, N, 4)
    scales: np.ndarray  # (S, N, 3)
    opacities: np.ndarray  # (S, N)
    colors: np.ndarray  # (S, N, D), to see which are finite
    cameras: np.ndarray  # (I, CAMERA) float64

    @property
    def shares(self) -> np.ndarray:
        """(I, 5) int64: which entry of each of the five an image reads."""
        arrays = (self.means, self.quats, self.scales, self.opacities, self.colors)
        return np.stack([share_of(len(part), len(self.cameras)) for part in arrays], 1)


@dataclass(frozen=True)
class Projected:
    """The Gaussians on the image planes."""

    geom: np.ndarray  # (I, N, 16) float32, see kernels.geometry
    depths: np.ndarray  # (I, N) float32, 0 where culled
    rows: np.ndarray  # (I, N) int32, rows of tiles touched
    radii: np.ndarray  # (I, N, 2) int32, half the size of the visible part in pixels
    compensations: np.ndarray  # (I, N) float32, or empty


@dataclass(frozen=True)
class Lists:
    """Which Gaussians each tile blends, in which order."""

    start: np.ndarray  # (tiles + 1,) int64
    entries: np.ndarray  # (E,) uint64
    first_entry: np.ndarray  # (I * N + 1,) int32
    visible: np.ndarray  # (I,) int64


@dataclass(frozen=True)
class Drawn:
    """Images, and what the backward pass needs beside them."""

    images: np.ndarray  # (I, H, W, D) float32
    alphas: np.ndarray  # (I, H, W, 1) float32
    remaining: np.ndarray  # (I, H, W) float32, transmittance
    stops: np.ndarray  # (tiles,) int64
    pairs: np.ndarray  # (tiles,) int64


def share_of(shared: int, images: int) -> np.ndarray:
    """Which of `shared` entries each image reads."""
    return np.arange(images, dtype=np.int64) // max(1, images // max(1, shared))


def camera_rows(viewmats: np.ndarray, Ks: np.ndarray, options: Options) -> np.ndarray:
    """(I, CAMERA) numbers for the kernels; a camera that is not usable sees nothing.

    Args:
        viewmats: (I, 4, 4) world to camera.
        Ks: (I, 3, 3) px.
        options: for the image size.
    """
    rows = np.zeros((len(viewmats), CAMERA))
    fx, fy, cx, cy = Ks[:, 0, 0], Ks[:, 1, 1], Ks[:, 0, 2], Ks[:, 1, 2]
    rows[:, :9] = viewmats[:, :3, :3].reshape(-1, 9)
    rows[:, 9:12] = viewmats[:, :3, 3]
    rows[:, 12:16] = np.stack((fx, fy, cx, cy), 1)
    usable = np.isfinite(rows).all(1) & (fx > 0) & (fy > 0)
    rows[~usable] = 0.0
    rows[~usable, 11] = -1.0  # everything lies behind it
    rows[~usable, 12:14] = 1.0
    for axis, size in ((0, options.width), (1, options.height)):
        margin, center, focal = rules.FRUSTUM_MARGIN * size, rows[:, 14 + axis], rows[:, 12 + axis]
        rows[:, 16 + 2 * axis] = -(center + margin) / focal
        rows[:, 17 + 2 * axis] = (size - center + margin) / focal
    return rows


def project_stage(inputs: Inputs, options: Options) -> Projected:
    """Culls and projects."""
    images, gaussians = len(inputs.cameras), inputs.means.shape[1]
    projected = Projected(
        geom=lease((images, gaussians, geometry.ROW), np.float32),
        depths=lease((images, gaussians), np.float32),
        rows=lease((images, gaussians), np.int32),
        radii=np.empty((images, gaussians, 2), np.int32),
        compensations=lease((images, gaussians if options.antialiased else 0), np.float32),
    )
    run(
        project,
        thread_count(images * gaussians // PIECE),
        inputs.means.reshape(-1),
        inputs.quats.reshape(-1),
        inputs.scales.reshape(-1),
        inputs.opacities.reshape(-1),
        inputs.colors.reshape(-1),
        inputs.colors.shape[-1],
        inputs.shares,
        inputs.cameras,
        gaussians,
        float(options.width),
        float(options.height),
        options.near_plane,
        options.far_plane,
        options.eps2d,
        options.antialiased,
        projected.geom.reshape(-1),
        projected.depths.reshape(-1),
        projected.rows.reshape(-1),
        projected.radii.reshape(-1),
        projected.compensations.reshape(-1),
    )
    return projected


def list_stage(projected: Projected, options: Options) -> Lists:
    """Sorts by depth and lists the splats of each tile."""
    images, gaussians = projected.depths.shape
    chunks = max(1, min(thread_count(gaussians // _CHUNK), 32))
    order = lease((images, gaussians), np.int32)
    visible = np.empty(images, np.int64)
    chunk_rows = np.empty((images, chunks + 1), np.int64)
    run(
        sort_by_depth,
        thread_count(images),
        projected.depths,
        projected.rows,
        order,
        lease((images, gaussians), np.int32),
        visible,
        chunk_rows,
    )
    image_spans = np.zeros(images + 1, np.int64)
    np.cumsum(chunk_rows[:, -1], out=image_spans[1:])
    tiles_x = -(-options.width // TILE_WIDTH)
    tiles = tiles_x * -(-options.height // TILE_HEIGHT)
    spans = lease((int(image_spans[-1]),), np.uint32)
    heads = lease((images, gaussians), np.uint32)
    counts = lease((images, chunks, tiles), np.int32)
    entry_count = lease((images, gaussians), np.int32)
    entry_count[:] = 0
    threads = thread_count(images * chunks)
    run(
        count_tiles, threads, projected.geom.reshape(-1), order, visible, chunk_rows, image_spans,
        tiles_x, options.width, spans, heads, counts, entry_count,
    )  # fmt: skip
    start = np.empty(images * tiles + 1, np.int64)
    first_entry = lease((images * gaussians + 1,), np.int32)
    number = place_tiles(counts, entry_count, start, first_entry)
    if number < 0:
        raise HwpError(
            "the splats cover more than 2^31 tiles together",
            field="scales",
            remedy="Draw fewer or smaller Gaussians, or a smaller image, at a time",
        )
    lists = Lists(start, lease((number,), np.uint64), first_entry, visible)
    run(
        fill_tiles, threads, order, visible, heads, chunk_rows, image_spans, spans, counts,
        first_entry, tiles_x, lists.entries,
    )  # fmt: skip
    return lists


def _channels(size: int) -> int | tuple[int, ...]:
    return (0,) * size if size in UNROLLED else size


def blend_stage(
    projected: Projected,
    lists: Lists,
    colors: np.ndarray,
    backgrounds: np.ndarray,
    options: Options,
    drawn: Drawn,
) -> None:
    """Draws into `drawn`."""
    images, gaussians = projected.depths.shape
    run(
        blend,
        thread_count(len(drawn.stops)),
        lists.start,
        lists.entries,
        projected.geom.reshape(-1),
        colors.reshape(-1),
        share_of(len(colors), images),
        backgrounds,
        options.width,
        options.height,
        gaussians,
        drawn.images.reshape(-1),
        drawn.alphas.reshape(-1),
        drawn.remaining.reshape(-1),
        drawn.stops,
        drawn.pairs,
        _channels(colors.shape[-1]),
        options.count_pairs,
    )


@dataclass(frozen=True)
class BlendGradients:
    """Gradients of what was blended."""

    means2d: np.ndarray  # (I, N, 2)
    shapes: np.ndarray  # (I, N, 3), see kernels.reduce
    opacities: np.ndarray  # (S, N)
    colors: np.ndarray  # (S, N, D)


def blend_backward_stage(
    projected: Projected,
    lists: Lists,
    opacities: np.ndarray,
    colors: np.ndarray,
    drawn: Drawn,
    v_images: np.ndarray,
    v_alphas: np.ndarray,
    options: Options,
    gradients: BlendGradients,
) -> None:
    """Fills `gradients`, of which opacities and colors must be zeros."""
    images, gaussians = projected.depths.shape
    size = colors.shape[-1]
    looked_at = drawn.stops - lists.start[:-1]
    first_slot = np.cumsum(looked_at) - looked_at
    slot_size = channel_kernels.slot_size(size, size in UNROLLED)
    slots = lease((int(looked_at.sum()), slot_size), np.float32)
    slot_of = lease((len(lists.entries),), np.int32)
    run(
        blend_backward,
        thread_count(len(drawn.stops)),
        lists.start,
        drawn.stops,
        first_slot,
        lists.entries,
        projected.geom.reshape(-1),
        colors.reshape(-1),
        share_of(len(colors), images),
        options.width,
        options.height,
        gaussians,
        drawn.images.reshape(-1),
        drawn.remaining.reshape(-1),
        v_images.reshape(-1),
        v_alphas.reshape(-1),
        slots.reshape(-1),
        slot_size,
        slot_of,
        _channels(size),
    )
    run(
        reduce_slots,
        thread_count(gaussians // PIECE),
        gaussians,
        size,
        projected.geom.reshape(-1),
        opacities.reshape(-1),
        share_of(len(opacities), images),
        share_of(len(colors), images),
        lists.first_entry,
        projected.depths,
        slot_of,
        slots.reshape(-1),
        slot_size,
        gradients.means2d.reshape(-1),
        gradients.shapes.reshape(-1),
        gradients.opacities.reshape(-1),
        gradients.colors.reshape(-1),
    )


def background_backward_stage(v_images: np.ndarray, remaining: np.ndarray) -> np.ndarray:
    """Gradient of the backgrounds (I, D), float64."""
    images, height, _, size = v_images.shape
    lines = np.empty((images, height, size))
    run(background_backward, thread_count(images * height), v_images, remaining, lines)
    return lines.sum(1)


@dataclass(frozen=True)
class ProjectGradients:
    """Gradients of what was projected; zeros to begin with."""

    means: np.ndarray  # (S, N, 3)
    quats: np.ndarray  # (S, N, 4)
    scales: np.ndarray  # (S, N, 3)


def project_backward_stage(
    inputs: Inputs,
    projected: Projected,
    v_means2d: np.ndarray,
    v_shapes: np.ndarray,
    v_depths: np.ndarray,
    v_compensations: np.ndarray,
    options: Options,
    want_cameras: bool,
    gradients: ProjectGradients,
) -> np.ndarray:
    """Fills `gradients`; returns (I, 12) float64, rotation row by row and translation."""
    images, gaussians = projected.depths.shape
    pieces = max(1, gaussians // PIECE)
    v_cameras = np.zeros((images, pieces if want_cameras else 0, 12))
    run(
        project_backward,
        thread_count(pieces),
        inputs.means.reshape(-1),
        inputs.quats.reshape(-1),
        inputs.scales.reshape(-1),
        inputs.shares,
        inputs.cameras,
        gaussians,
        projected.depths.reshape(-1),
        options.eps2d,
        v_means2d.reshape(-1),
        v_shapes.reshape(-1),
        v_depths.reshape(-1),
        v_compensations.reshape(-1),
        options.antialiased,
        want_cameras,
        gradients.means.reshape(-1),
        gradients.quats.reshape(-1),
        gradients.scales.reshape(-1),
        v_cameras,
    )
    return v_cameras.sum(1)
