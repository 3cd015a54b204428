"""The stages of the CPU backend's forward pass, from arrays to arrays.

Each call owns what it makes; nothing here uses torch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import psutil

from hwp_bench.base.errors import HwpError
from wildghand.splat.kernels import geometry
from wildghand.splat.kernels.bins import count_tiles, fill_tiles, place_tiles
from wildghand.splat.kernels.blend import blend
from wildghand.splat.kernels.cameras import CAMERA, prepare_cameras
from wildghand.splat.kernels.project import PIECE, Ellipsoids, Projected, View, project
from wildghand.splat.kernels.sort import sort_by_depth
from wildghand.splat.kernels.tiles import TILE_HEIGHT, TILE_WIDTH
from wildghand.splat.memory import lease
from wildghand.splat.scene import Options
from wildghand.splat.threads import even_jobs, run, thread_count, weighted_jobs

#: Numbers of channels for which the blending kernels are compiled unrolled.
UNROLLED = (3,)
#: Memory of a (Gaussian, tile) pair: its entry, and the least that the backward pass adds.
_BYTES_PER_ENTRY = 12
#: Bytes that are allocated without asking how much the machine has.
_LITTLE = 1 << 30
#: Most chunks: each has a counter for every tile.
_MOST_CHUNKS = 32


@dataclass(frozen=True)
class Lists:
    """Which Gaussians each tile blends, in which order."""

    start: np.ndarray  # (tiles + 1,) int64
    entries: np.ndarray  # (E,) uint64, see kernels.bins
    first_entry: np.ndarray  # (I * N + 1,) int32
    visible: np.ndarray  # (I,) int64, Gaussians on screen


@dataclass(frozen=True)
class Drawn:
    """The results of blending besides images and alphas."""

    remaining: np.ndarray  # (I, H, W) float32, transmittance
    stops: np.ndarray  # (tiles,) int64, where each list was left because of saturation
    pairs: np.ndarray  # (tiles,) int64, blended (Gaussian, pixel) pairs if counted


def repeat_of(shared: np.ndarray, images: int) -> int:
    """How many images in a row read the same entry of an array."""
    return images // max(1, len(shared))


def camera_rows(viewmats: np.ndarray, Ks: np.ndarray, options: Options) -> np.ndarray:
    """(I, CAMERA) numbers for the kernels; a camera that is not usable sees nothing.

    Args:
        viewmats: (I, 4, 4) float64, world to camera.
        Ks: (I, 3, 3) float64, px.
        options: for the image size.
    """
    rows = np.empty((len(viewmats), CAMERA))
    prepare_cameras(viewmats, Ks, options.width, options.height, rows)
    return rows


def view_of(options: Options) -> View:
    """The options that the projection reads."""
    return View(
        width=float(options.width),
        height=float(options.height),
        near=options.near_plane,
        far=options.far_plane,
        eps2d=options.eps2d,
        antialiased=options.antialiased,
    )


def project_stage(
    ellipsoids: Ellipsoids,
    opacities: np.ndarray,
    colors: np.ndarray,
    cameras: np.ndarray,
    options: Options,
) -> Projected:
    """Culls and projects.

    Args:
        ellipsoids: S entries of N Gaussians, N at least `rows.GROUP`.
        opacities: (S, N) float32.
        colors: (S, N, D) float32, to see which are finite.
        cameras: (I, CAMERA) float64.
        options: of the call.
    """
    images, gaussians = len(cameras), ellipsoids.means.shape[1]
    projected = Projected(
        geom=lease((images, gaussians, geometry.ROW), np.float32),
        depths=lease((images, gaussians), np.float32),
        rows=lease((images, gaussians), np.int32),
        radii=lease((images, gaussians, 2), np.int32),
        compensations=lease((images, gaussians if options.antialiased else 0), np.float32),
    )
    jobs = images * max(1, gaussians // PIECE)
    run(
        project,
        even_jobs(jobs, thread_count(jobs, images * gaussians)),
        ellipsoids,
        opacities,
        colors,
        cameras,
        view_of(options),
        projected,
    )
    return projected


def list_stage(projected: Projected, options: Options) -> Lists:
    """Sorts by depth and lists the splats of each tile.

    Raises:
        HwpError: more (splat, tile) pairs than can be counted or held.
    """
    images, gaussians = projected.depths.shape
    chunks = min(thread_count(_MOST_CHUNKS, gaussians), _MOST_CHUNKS)
    order = lease((images, gaussians), np.int32)
    spare = lease((images, gaussians), np.int32)
    visible = np.empty(images, np.int64)
    chunk_rows = np.empty((images, chunks + 1), np.int64)
    run(
        sort_by_depth,
        even_jobs(images, thread_count(images, images * gaussians)),
        projected.depths,
        projected.rows,
        order,
        spare,
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
    shares = even_jobs(images * chunks, thread_count(images * chunks, images * gaussians))
    run(
        count_tiles,
        shares,
        projected.geom.reshape(-1),
        order,
        visible,
        chunk_rows,
        image_spans,
        tiles_x,
        options.width,
        spans,
        heads,
        counts,
        entry_count,
    )
    start = np.empty(images * tiles + 1, np.int64)
    first_entry = lease((images * gaussians + 1,), np.int32)
    number = place_tiles(counts, entry_count, start, first_entry)
    _check_room(number)
    entries = lease((number,), np.uint64)
    run(
        fill_tiles,
        shares,
        order,
        visible,
        heads,
        chunk_rows,
        image_spans,
        spans,
        counts,
        first_entry,
        tiles_x,
        entries,
    )
    return Lists(start, entries, first_entry, visible)


def tile_jobs(start: np.ndarray) -> np.ndarray:
    """Shares of the tiles for `run`, by the lengths of their lists.

    Args:
        start: where the list of each tile starts, and the end of the last.
    """
    tiles, entries = len(start) - 1, int(start[-1])
    # A tile without splats is work, too: its background.
    return weighted_jobs(start + np.arange(tiles + 1), thread_count(tiles, entries))


def _check_room(entries: int) -> None:
    """Refuses lists that cannot be held, before the system ends the process for them."""
    needed = entries * _BYTES_PER_ENTRY
    if 0 <= needed < _LITTLE or 0 <= needed < psutil.virtual_memory().available:
        return
    size = f"{needed / 2**30:.0f} GiB of memory" if entries >= 0 else "lists of more than 2^31"
    raise HwpError(
        f"the Gaussians cover so many pixels that drawing them needs {size}",
        field="scales",
        remedy="Draw fewer or smaller Gaussians, or a smaller image, at a time",
    )


def kernel_channels(size: int) -> int | tuple[int, ...]:
    """How the blending kernels are told the number of channels, see kernels.channels."""
    return (0,) * size if size in UNROLLED else size


def blend_stage(
    projected: Projected,
    lists: Lists,
    colors: np.ndarray,
    backgrounds: np.ndarray,
    options: Options,
    images: np.ndarray,
    alphas: np.ndarray,
) -> Drawn:
    """Draws into images (I, H, W, D) and alphas (I, H, W, 1).

    Args:
        projected, lists: from the stages before.
        colors: (S, N, D) float32.
        backgrounds: (I, D) float32.
        options: of the call.
        images, alphas: float32, overwritten.
    """
    tiles = len(lists.start) - 1
    drawn = Drawn(
        remaining=lease(images.shape[:3], np.float32),
        stops=np.empty(tiles, np.int64),
        pairs=np.empty(tiles, np.int64),
    )
    run(
        blend,
        tile_jobs(lists.start),
        lists.start,
        lists.entries,
        projected.geom.reshape(-1),
        colors.reshape(-1),
        repeat_of(colors, len(images)),
        backgrounds,
        options.width,
        options.height,
        projected.depths.shape[1],
        images.reshape(-1),
        alphas.reshape(-1),
        drawn.remaining.reshape(-1),
        drawn.stops,
        drawn.pairs,
        kernel_channels(colors.shape[-1]),
        options.count_pairs,
    )
    return drawn
