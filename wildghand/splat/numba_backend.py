"""CPU backend: the compiled kernels as two steps that autograd knows, project and blend.

They are two so that the means on the image plane and the depths are tensors of the graph: users of
gsplat read the gradient of `info["means2d"]` to densify.
"""

from __future__ import annotations

import functools
import logging
import threading
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import psutil
import torch

from hwp_bench.base.errors import HwpError
from hwp_bench.base.kernels import on_disk
from wildghand.splat.kernels.blend import (
    BlendGradients,
    TileScene,
    background_backward,
    blend,
    blend_backward,
    reduce_slots,
)
from wildghand.splat.kernels.lists import Walk, count_tiles, fill_tiles, place_tiles, sort_by_depth
from wildghand.splat.kernels.project import (
    CAMERA,
    GROUP,
    PIECE,
    Ellipsoids,
    PlaneGradients,
    Projected,
    View,
    prepare_cameras,
    project,
    project_backward,
)
from wildghand.splat.kernels.tiles import (
    MEAN_X,
    MEAN_Y,
    ROW,
    SHEAR,
    TILE_HEIGHT,
    TILE_WIDTH,
    slot_size,
)
from wildghand.splat.scene import (
    FlatScene,
    Options,
    channel_count,
    channels_with_depth,
    expected_depth,
    per_image,
    unflattened,
)
from wildghand.splat.threads import lease, run, run_jobs, thread_count, weighted_jobs

#: Numbers of channels for which the blending kernels are compiled unrolled.
UNROLLED = (3,)
#: Memory of a (Gaussian, tile) pair: its entry, and the least that the backward pass adds.
_BYTES_PER_ENTRY = 12
#: Bytes that are allocated without asking how much the machine has.
_LITTLE = 1 << 30
#: Most chunks of the sorted Gaussians: each has a counter for every tile.
_MOST_CHUNKS = 32
#: Pixels of the background's gradient that take as long as a (Gaussian, tile) pair.
_PIXELS_LIKE_A_PAIR = 20

#: Every kernel that a call runs.
KERNELS: tuple[Any, ...] = (
    prepare_cameras, project, sort_by_depth, count_tiles, place_tiles, fill_tiles, blend,
    blend_backward, reduce_slots, background_backward, project_backward,
)  # fmt: skip

_log = logging.getLogger("wildghand.splat")
_lock = threading.Lock()


@dataclass(frozen=True)
class Lists:
    """Which Gaussians each tile blends, in which order."""

    start: np.ndarray  # (tiles + 1,) int64
    entries: np.ndarray  # (E,) uint64, see kernels.lists
    first_entry: np.ndarray  # (I * N + 1,) int32
    visible: np.ndarray  # (I,) int64, Gaussians on screen


@dataclass
class RasterCall:
    """The data that one call of `rasterize` keeps for its backward pass; it is not shared.

    The forward steps fill in their results, in this order.
    """

    options: Options
    cameras: np.ndarray  # (I, CAMERA) float64
    projected: Projected = field(init=False)
    lists: Lists = field(init=False)
    remaining: np.ndarray = field(init=False)  # (I, H, W) float32, transmittance
    stops: np.ndarray = field(init=False)  # (tiles,) int64, where saturation ended each list
    pairs: np.ndarray = field(init=False)  # (tiles,) int64, blended pairs if counted

    @property
    def view(self) -> View:
        """The options that the projection reads."""
        o = self.options
        size = float(o.width), float(o.height)
        return View(*size, o.near_plane, o.far_plane, o.eps2d, o.antialiased)

    def tile_scene(self, colors: torch.Tensor) -> TileScene:
        """Return the input of both passes over tiles."""
        images, gaussians = self.projected.depths.shape
        shared = _gaussians(colors)
        return TileScene(
            start=self.lists.start,
            entries=self.lists.entries,
            geom=self.projected.geom.reshape(-1),
            colors=shared.reshape(-1),
            color_repeat=images // max(1, len(shared)),
            width=self.options.width,
            height=self.options.height,
            gaussians=gaussians,
        )


def rasterize_numba(scene: FlatScene) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Draws the scene, float32 on the CPU: channels (I, H, W, X), alphas, its part of `info`."""
    warm_up(channel_count(scene))
    return _draw(scene)


def _draw(scene: FlatScene) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    options = scene.options
    cameras = np.empty((scene.images, CAMERA))
    given = (m.detach().double().contiguous().numpy() for m in (scene.viewmats, scene.Ks))
    prepare_cameras(*given, options.width, options.height, cameras)
    call = RasterCall(options, cameras)
    ellipsoids = (scene.means.contiguous(), scene.quats.contiguous(), scene.scales.contiguous())
    looks = (scene.opacities.contiguous(), scene.colors.contiguous())
    means2d, shapes, depths, compensations = Project.apply(
        *ellipsoids, scene.viewmats, *looks, call
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
        pairs = torch.from_numpy(call.pairs).reshape(scene.images, -1).sum(1)
        info["pairs"] = unflattened(pairs, scene)
    return expected_depth(images, alphas, options.render_mode), alphas, info


class Project(torch.autograd.Function):
    """(means2d, shapes, depths, compensations) of a scene."""

    @staticmethod
    def forward(
        ctx: Any,
        means: torch.Tensor,
        quats: torch.Tensor,
        scales: torch.Tensor,
        viewmats: torch.Tensor,
        opacities: torch.Tensor,
        colors: torch.Tensor,
        call: RasterCall,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Culls and projects flat contiguous float32 tensors; `call` gets `projected`."""
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(means, quats, scales, viewmats)
        ctx.call = call
        ellipsoids = Ellipsoids(_gaussians(means), _gaussians(quats), _gaussians(scales))
        images, gaussians = len(call.cameras), ellipsoids.means.shape[1]
        call.projected = projected = Projected(
            geom=lease((images, gaussians, ROW), np.float32),
            depths=lease((images, gaussians), np.float32),
            rows=lease((images, gaussians), np.int32),
            radii=lease((images, gaussians, 2), np.int32),
            compensations=lease((images, gaussians * call.options.antialiased), np.float32),
        )
        looks = (_gaussians(opacities), _gaussians(colors))
        jobs, work = images * max(1, gaussians // PIECE), images * gaussians
        run_jobs(project, jobs, work, ellipsoids, *looks, call.cameras, call.view, projected)
        count = means.shape[1]
        geom = torch.from_numpy(projected.geom)[:, :count]
        # The values of `shapes` are never read: it is there for its gradient.
        return (
            geom[..., MEAN_X : MEAN_Y + 1],
            geom[..., SHEAR : SHEAR + 3],
            torch.from_numpy(projected.depths)[:, :count],
            torch.from_numpy(projected.compensations)[:, :count],
        )

    @staticmethod
    def backward(ctx: Any, *upstream: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        """Gradients of `forward`'s arguments."""
        _refuse_second_order()
        call: RasterCall = ctx.call
        means, quats, scales, viewmats = ctx.saved_tensors
        images, gaussians = call.projected.depths.shape
        # Without a gradient: zeros, but none at all for the depths, which are skipped then.
        empty = ((images, gaussians, 2), (images, gaussians, 3), (0, 0), (images, gaussians))
        given = PlaneGradients(
            *(
                np.zeros(shape, np.float32) if v is None else _gaussians(v.contiguous())
                for v, shape in zip(upstream, empty, strict=True)
            )
        )
        made = [_like_gaussians(tensor) for tensor in (means, quats, scales)]
        pieces, with_cameras = max(1, gaussians // PIECE), ctx.needs_input_grad[3]
        v_cameras = np.zeros((images, pieces if with_cameras else 0, 12))
        ellipsoids = Ellipsoids(_gaussians(means), _gaussians(quats), _gaussians(scales))
        gradients = Ellipsoids(*(_array(tensor) for tensor in made))
        seen = (call.cameras, call.projected.depths, call.view)
        work = images * gaussians
        run_jobs(project_backward, pieces, work, ellipsoids, *seen, given, gradients, v_cameras)
        v_viewmats = None
        if with_cameras:
            rows = torch.from_numpy(v_cameras.sum(1))
            v_viewmats = torch.zeros_like(viewmats)
            v_viewmats[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
            v_viewmats[:, :3, 3] = rows[:, 9:]
        return (*(v[:, : means.shape[1]] for v in made), v_viewmats, None, None, None)


class Blend(torch.autograd.Function):
    """(images, alphas) of a projected scene."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: torch.Tensor,
        shapes: torch.Tensor,
        opacities: torch.Tensor,
        colors: torch.Tensor,
        backgrounds: torch.Tensor,
        call: RasterCall,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The results of `Project` for `call`, then flat contiguous tensors to blend."""
        ctx.set_materialize_grads(False)
        options = call.options
        shape = (len(backgrounds), options.height, options.width)
        images, alphas = torch.empty(*shape, colors.shape[-1]), torch.empty(*shape, 1)
        call.lists = _list_tiles(call.projected, options)
        tiles = len(call.lists.start) - 1
        call.remaining = lease(shape, np.float32)
        call.stops, call.pairs = np.empty(tiles, np.int64), np.empty(tiles, np.int64)
        run(
            blend,
            _tile_shares(call.lists.start),
            call.tile_scene(colors),
            _array(backgrounds),
            *(array.reshape(-1) for array in (_array(images), _array(alphas), call.remaining)),
            call.stops,
            call.pairs,
            _kernel_channels(colors.shape[-1]),
            options.count_pairs,
        )
        ctx.save_for_backward(opacities, colors, images)
        ctx.call = call
        return images, alphas

    @staticmethod
    def backward(
        ctx: Any, v_images: torch.Tensor | None, v_alphas: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, ...]:
        """Gradients of `forward`'s arguments."""
        _refuse_second_order()
        call: RasterCall = ctx.call
        opacities, colors, images = ctx.saved_tensors
        if v_images is None:
            v_images = torch.zeros_like(images)
        if v_alphas is None:
            v_alphas = torch.empty(0)
        upstream = _array(v_images.contiguous())
        lists, projected = call.lists, call.projected
        count, gaussians = projected.depths.shape
        size = colors.shape[-1]
        looked_at = call.stops - lists.start[:-1]
        first_slot = np.cumsum(looked_at) - looked_at
        floats = slot_size(size, size in UNROLLED)
        slots = lease((int(looked_at.sum()), floats), np.float32)
        slot_of = lease((len(lists.entries),), np.int32)
        read = (_array(images), call.remaining, upstream, _array(v_alphas.contiguous()), slots)
        run(
            blend_backward,
            _tile_shares(np.append(first_slot, len(slots))),
            call.tile_scene(colors),
            call.stops,
            first_slot,
            *(array.reshape(-1) for array in read),
            floats,
            slot_of,
            _kernel_channels(size),
        )
        shapes = (torch.empty(count, gaussians, 2), torch.empty(count, gaussians, 3))
        made = [*shapes, _like_gaussians(opacities), _like_gaussians(colors)]
        run_jobs(
            reduce_slots,
            max(1, gaussians // PIECE),
            count * gaussians,
            projected.geom,
            projected.depths,
            _gaussians(opacities),
            lists.first_entry,
            slot_of,
            slots,
            BlendGradients(*(_array(v) for v in made)),
        )
        v_backgrounds = None
        if ctx.needs_input_grad[4]:
            lines = np.empty((*upstream.shape[:2], size))
            jobs, pixels = images.shape[:2].numel(), images.shape[:3].numel()
            work = pixels // _PIXELS_LIKE_A_PAIR
            run_jobs(background_backward, jobs, work, upstream, call.remaining, lines)
            v_backgrounds = torch.from_numpy(lines.sum(1)).float()
        return (*(v[:, : opacities.shape[1]] for v in made), v_backgrounds, None)


def _tile_shares(before: np.ndarray) -> np.ndarray:
    """Shares of the tiles for `run`, by (tiles + 1,) entries before each, and of all."""
    tiles, entries = len(before) - 1, int(before[-1])
    # A tile without splats is work, too: its background.
    return weighted_jobs(before + np.arange(tiles + 1), thread_count(tiles, entries))


def _list_tiles(projected: Projected, options: Options) -> Lists:
    """Sorts by depth and lists the splats of each tile."""
    images, gaussians = projected.depths.shape
    work = images * gaussians
    chunks = min(thread_count(_MOST_CHUNKS, gaussians), _MOST_CHUNKS)
    order, spare = (lease((images, gaussians), np.int32) for _ in range(2))
    visible = np.empty(images, np.int64)
    chunk_rows = np.empty((images, chunks + 1), np.int64)
    depths, rows = projected.depths, projected.rows
    run_jobs(sort_by_depth, images, work, depths, rows, order, spare, visible, chunk_rows)
    image_spans = np.zeros(images + 1, np.int64)
    np.cumsum(chunk_rows[:, -1], out=image_spans[1:])
    tiles_x = -(-options.width // TILE_WIDTH)
    tiles = tiles_x * -(-options.height // TILE_HEIGHT)
    heads = lease((images, gaussians), np.uint32)
    spans = lease((int(image_spans[-1]),), np.uint32)
    walk = Walk(order, visible, chunk_rows, image_spans, heads, spans, tiles_x)
    counts = lease((images, chunks, tiles), np.int32)
    entry_count = lease((images, gaussians), np.int32)
    entry_count[:] = 0
    geom, jobs = projected.geom.reshape(-1), images * chunks
    run_jobs(count_tiles, jobs, work, geom, walk, options.width, counts, entry_count)
    start = np.empty(images * tiles + 1, np.int64)
    first_entry = lease((work + 1,), np.int32)
    number = place_tiles(counts, entry_count, start, first_entry)
    _check_room(number)
    entries = lease((number,), np.uint64)
    run_jobs(fill_tiles, jobs, work, walk, counts, first_entry, entries)
    return Lists(start, entries, first_entry, visible)


def _check_room(entries: int) -> None:
    """Refuse lists that do not fit in memory, before the system ends the process."""
    needed = entries * _BYTES_PER_ENTRY
    if 0 <= needed < _LITTLE or 0 <= needed < psutil.virtual_memory().available:
        return
    size = f"{needed / 2**30:.0f} GiB of memory" if entries >= 0 else "lists of more than 2^31"
    raise HwpError(
        f"the Gaussians cover so many pixels that drawing them needs {size}",
        field="scales",
        remedy="Draw fewer or smaller Gaussians, or a smaller image, at a time",
    )


def _kernel_channels(size: int) -> int | tuple[int, ...]:
    """The form in which the blending kernels get the number of channels; see kernels.tiles."""
    return (0,) * size if size in UNROLLED else size


def _array(tensor: torch.Tensor) -> np.ndarray:
    """A contiguous tensor's own memory."""
    return tensor.detach().numpy()


def _gaussians(tensor: torch.Tensor) -> np.ndarray:
    """A (S, N, ...) tensor's memory; a copy with zeros after if N is less than the group.

    A Gaussian of zeros has no rotation, so it is culled.
    """
    missing = GROUP - tensor.shape[1]
    if missing <= 0:
        return _array(tensor)
    return np.pad(_array(tensor), [(0, 0), (0, missing)] + [(0, 0)] * (tensor.ndim - 2))


def _like_gaussians(tensor: torch.Tensor) -> torch.Tensor:
    """Allocate a gradient, for at least one group of Gaussians."""
    return torch.empty(tensor.shape[0], max(tensor.shape[1], GROUP), *tensor.shape[2:])


def _refuse_second_order() -> None:
    """Refuse second derivatives, which would be silently wrong."""
    if torch.is_grad_enabled():
        raise HwpError(
            "the rasterizer has first derivatives only",
            field="create_graph",
            remedy='Leave create_graph off, or use backend="reference"',
        )


def warm_up(channels: int = UNROLLED[0]) -> None:
    """Makes the kernels ready; costs nothing from the second call on.

    Compiling takes some ten seconds, once on a machine. A person who waits is told on the log
    (level WARNING, which goes to standard error unless logging is set up otherwise). Numbers of
    channels that are not unrolled share one version, which few programs need.
    """
    with _lock:
        _warm_up(channels if channels in UNROLLED else max(UNROLLED) + 1)


@functools.cache
def _warm_up(channels: int) -> None:
    before = _compiled_here()
    if not all(on_disk(kernel) for kernel in KERNELS):
        _log.warning(
            "compiling the CPU rasterizer, once on this machine; it takes some ten seconds"
        )
    start = time.perf_counter()
    _draw_nothing(channels)
    if _compiled_here() > before:
        _log.warning("compiled the CPU rasterizer in %.1f s", time.perf_counter() - start)


def _compiled_here() -> int:
    """How many versions of kernels this process had to compile."""
    return sum(len(kernel.signatures) - sum(kernel.stats.cache_hits.values()) for kernel in KERNELS)


def _draw_nothing(channels: int) -> None:
    """Draws Gaussians that are all culled, and takes every gradient."""
    with torch.inference_mode(False), torch.enable_grad():

        def zeros(*shape: int) -> torch.Tensor:
            return torch.from_numpy(np.zeros(shape, np.float32)).requires_grad_()

        gaussians = zeros(1, GROUP, 3), zeros(1, GROUP, 4), zeros(1, GROUP, 3), zeros(1, GROUP)
        options = Options(1, 1, 0.01, 1e10, 0.3, "RGB", antialiased=False, count_pairs=False)
        scene = FlatScene(
            *gaussians,
            zeros(1, GROUP, channels),
            viewmats=zeros(1, 4, 4),
            Ks=torch.from_numpy(np.eye(3, dtype=np.float32)[None]),
            backgrounds=zeros(1, channels),
            options=options,
            image_dims=(1,),
        )
        images, _, _ = _draw(scene)
        images.backward(torch.zeros_like(images))
