"""The stages of the CPU backend's forward pass, from arrays to arrays.

Each call owns what it makes; nothing here uses torch.
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
from wildghand.splat.kernels.blend import (
    BlendGradients,
    background_backward,
    blend,
    blend_backward,
    reduce_slots,
)
from wildghand.splat.kernels.groups import GROUP
from wildghand.splat.kernels.jit import Kernel
from wildghand.splat.kernels.lists import count_tiles, fill_tiles, place_tiles, sort_by_depth
from wildghand.splat.kernels.project import (
    CAMERA,
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
from wildghand.splat.threads import even_jobs, lease, run, thread_count, weighted_jobs

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
        geom=lease((images, gaussians, ROW), np.float32),
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


#: Pixels of the background's gradient that take as long as a (Gaussian, tile) pair.
_PIXELS_LIKE_A_PAIR = 20


def blend_backward_stage(
    projected: Projected,
    lists: Lists,
    opacities: np.ndarray,
    colors: np.ndarray,
    drawn: Drawn,
    images: np.ndarray,
    v_images: np.ndarray,
    v_alphas: np.ndarray,
    options: Options,
    gradients: BlendGradients,
) -> None:
    """Fills `gradients`.

    Args:
        projected, lists, drawn, images: as the forward pass left them.
        opacities: (S, N) float32, as blended.
        colors: (S, N, D) float32.
        v_images, v_alphas: gradients of the loss, (I, H, W, D) and (I, H, W, 1) or (0,).
        options: of the call.
        gradients: overwritten.
    """
    count, gaussians = projected.depths.shape
    size = colors.shape[-1]
    looked_at = drawn.stops - lists.start[:-1]
    first_slot = np.cumsum(looked_at) - looked_at
    floats = slot_size(size, size in UNROLLED)
    slots = lease((int(looked_at.sum()), floats), np.float32)
    slot_of = lease((len(lists.entries),), np.int32)
    pieces = max(1, gaussians // PIECE)
    run(
        blend_backward,
        tile_jobs(np.append(first_slot, len(slots))),
        lists.start,
        drawn.stops,
        first_slot,
        lists.entries,
        projected.geom.reshape(-1),
        colors.reshape(-1),
        repeat_of(colors, count),
        options.width,
        options.height,
        gaussians,
        images.reshape(-1),
        drawn.remaining.reshape(-1),
        v_images.reshape(-1),
        v_alphas.reshape(-1),
        slots.reshape(-1),
        floats,
        slot_of,
        kernel_channels(size),
    )
    run(
        reduce_slots,
        even_jobs(pieces, thread_count(pieces, count * gaussians)),
        projected.geom,
        projected.depths,
        opacities,
        lists.first_entry,
        slot_of,
        slots,
        gradients,
    )


def background_backward_stage(v_images: np.ndarray, remaining: np.ndarray) -> np.ndarray:
    """Gradient of the backgrounds, (I, D) float64."""
    count, height, width, size = v_images.shape
    lines = np.empty((count, height, size))
    work = count * height * width // _PIXELS_LIKE_A_PAIR
    run(
        background_backward,
        even_jobs(count * height, thread_count(count * height, work)),
        v_images,
        remaining,
        lines,
    )
    return lines.sum(1)


def project_backward_stage(
    ellipsoids: Ellipsoids,
    cameras: np.ndarray,
    projected: Projected,
    upstream: PlaneGradients,
    options: Options,
    want_cameras: bool,
    gradients: Ellipsoids,
) -> np.ndarray:
    """Fills `gradients`.

    Args:
        ellipsoids, cameras: as projected.
        projected: from the forward pass.
        upstream: gradients of the loss by the projected Gaussians.
        options: of the call.
        want_cameras: whether the result is needed.
        gradients: overwritten.

    Returns:
        Gradients of the cameras, (I, 12) float64: rotation row by row, then translation.
    """
    count, gaussians = projected.depths.shape
    pieces = max(1, gaussians // PIECE)
    v_cameras = np.zeros((count, pieces if want_cameras else 0, 12))
    run(
        project_backward,
        even_jobs(pieces, thread_count(pieces, count * gaussians)),
        ellipsoids,
        cameras,
        projected.depths,
        view_of(options),
        upstream,
        gradients,
        v_cameras,
    )
    return v_cameras.sum(1)


@dataclass
class Call:
    """The data that one call of `rasterize` keeps for its backward pass; it is not shared.

    The forward steps fill in their results, in this order.
    """

    options: Options
    cameras: np.ndarray  # (I, CAMERA) float64
    projected: Projected = field(init=False)
    lists: Lists = field(init=False)
    drawn: Drawn = field(init=False)


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
        call: Call,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Flat contiguous float32 tensors of a `FlatScene`; `call` gets `projected`."""
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(means, quats, scales, viewmats)
        ctx.call = call
        call.projected = project_stage(
            Ellipsoids(_gaussians(means), _gaussians(quats), _gaussians(scales)),
            _gaussians(opacities),
            _gaussians(colors),
            call.cameras,
            call.options,
        )
        count = means.shape[1]
        geom = torch.from_numpy(call.projected.geom)[:, :count]
        # The values of `shapes` are never read: it is there for its gradient.
        return (
            geom[..., MEAN_X : MEAN_Y + 1],
            geom[..., SHEAR : SHEAR + 3],
            torch.from_numpy(call.projected.depths)[:, :count],
            torch.from_numpy(call.projected.compensations)[:, :count],
        )

    @staticmethod
    def backward(ctx: Any, *upstream: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        """Gradients of `forward`'s arguments."""
        _refuse_second_order()
        call: Call = ctx.call
        means, quats, scales, viewmats = ctx.saved_tensors
        shape = call.projected.depths.shape
        v_means2d, v_shapes, v_depths, v_compensations = (
            None if v is None else _gaussians(v.contiguous()) for v in upstream
        )
        made = [_like_gaussians(tensor) for tensor in (means, quats, scales)]
        rows = project_backward_stage(
            Ellipsoids(_gaussians(means), _gaussians(quats), _gaussians(scales)),
            call.cameras,
            call.projected,
            PlaneGradients(
                np.zeros((*shape, 2), np.float32) if v_means2d is None else v_means2d,
                np.zeros((*shape, 3), np.float32) if v_shapes is None else v_shapes,
                np.zeros((0, 0), np.float32) if v_depths is None else v_depths,
                np.zeros(shape, np.float32) if v_compensations is None else v_compensations,
            ),
            call.options,
            ctx.needs_input_grad[3],
            Ellipsoids(*(_array(tensor) for tensor in made)),
        )
        v_viewmats = None
        if ctx.needs_input_grad[3]:
            v_viewmats = torch.zeros_like(viewmats)
            v_viewmats[:, :3, :3] = torch.from_numpy(rows[:, :9].reshape(-1, 3, 3))
            v_viewmats[:, :3, 3] = torch.from_numpy(rows[:, 9:])
        count = means.shape[1]
        return (*(v[:, :count] for v in made), v_viewmats, None, None, None)


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
        call: Call,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The results of `Project` for `call`, then flat contiguous tensors to blend."""
        ctx.set_materialize_grads(False)
        options = call.options
        shape = (len(backgrounds), options.height, options.width)
        images, alphas = torch.empty(*shape, colors.shape[-1]), torch.empty(*shape, 1)
        call.lists = list_stage(call.projected, options)
        call.drawn = blend_stage(
            call.projected,
            call.lists,
            _gaussians(colors),
            _array(backgrounds),
            options,
            _array(images),
            _array(alphas),
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
        call: Call = ctx.call
        opacities, colors, images = ctx.saved_tensors
        if v_images is None:
            v_images = torch.zeros_like(images)
        if v_alphas is None:
            v_alphas = torch.empty(0)
        upstream = _array(v_images.contiguous())
        shape = call.projected.depths.shape
        v_means2d, v_shapes = torch.empty(*shape, 2), torch.empty(*shape, 3)
        v_opacities, v_colors = _like_gaussians(opacities), _like_gaussians(colors)
        blend_backward_stage(
            call.projected,
            call.lists,
            _gaussians(opacities),
            _gaussians(colors),
            call.drawn,
            _array(images),
            upstream,
            _array(v_alphas.contiguous()),
            call.options,
            BlendGradients(*(_array(v) for v in (v_means2d, v_shapes, v_opacities, v_colors))),
        )
        v_backgrounds = None
        if ctx.needs_input_grad[4]:
            sums = background_backward_stage(upstream, call.drawn.remaining)
            v_backgrounds = torch.from_numpy(sums).float()
        count = opacities.shape[1]
        gradients = (v[:, :count] for v in (v_means2d, v_shapes, v_opacities, v_colors))
        return (*gradients, v_backgrounds, None)


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
    """Room for a gradient, with at least a group of Gaussians."""
    return torch.empty(tensor.shape[0], max(tensor.shape[1], GROUP), *tensor.shape[2:])


def _refuse_second_order() -> None:
    """Refuse second derivatives, which would be silently wrong.

    Raises:
        HwpError: the backward pass itself is being recorded.
    """
    if torch.is_grad_enabled():
        raise HwpError(
            "the rasterizer has first derivatives only",
            field="create_graph",
            remedy='Leave create_graph off, or use backend="reference"',
        )


def rasterize_numba(scene: FlatScene) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Draws the scene, float32 on the CPU; see `wildghand.splat.rasterize`.

    Returns:
        channels (I, H, W, X), alphas (I, H, W, 1) and the backend's part of `info`.
    """
    options = scene.options
    warm_up(channel_count(scene))
    call = Call(
        options,
        camera_rows(
            scene.viewmats.detach().double().contiguous().numpy(),
            scene.Ks.detach().double().contiguous().numpy(),
            options,
        ),
    )
    means2d, shapes, depths, compensations = Project.apply(
        scene.means.contiguous(),
        scene.quats.contiguous(),
        scene.scales.contiguous(),
        scene.viewmats,
        scene.opacities.contiguous(),
        scene.colors.contiguous(),
        call,
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
        pairs = torch.from_numpy(call.drawn.pairs).reshape(scene.images, -1).sum(1)
        info["pairs"] = unflattened(pairs, scene)
    return expected_depth(images, alphas, options.render_mode), alphas, info


_log = logging.getLogger("wildghand.splat")
_lock = threading.Lock()


def warm_up(channels: int = UNROLLED[0]) -> None:
    """Makes the kernels ready; costs nothing from the second call on.

    Compiling takes some ten seconds, once on a machine. A person who waits is told on the log
    (level WARNING, which goes to standard error unless logging is set up otherwise).

    Args:
        channels: how many are to be blended. Numbers that are not unrolled share one version,
            which few programs need.
    """
    with _lock:
        _warm_up(channels if channels in UNROLLED else None)


@functools.cache
def _warm_up(unrolled: int | None) -> None:
    kernels = all_kernels()
    before = sum(kernel.compiled_here() for kernel in kernels)
    if not all(kernel.on_disk() for kernel in kernels):
        _log.warning(
            "compiling the CPU rasterizer, once on this machine; it takes some ten seconds"
        )
    start = time.perf_counter()
    _draw_nothing(max(UNROLLED) + 1 if unrolled is None else unrolled)
    if sum(kernel.compiled_here() for kernel in kernels) > before:
        _log.warning("compiled the CPU rasterizer in %.1f s", time.perf_counter() - start)


def all_kernels() -> list[Kernel]:
    """Every kernel that the stages call."""
    return [value for value in globals().values() if isinstance(value, Kernel)]


def _draw_nothing(channels: int) -> None:
    """Runs every stage, forward and backward, on Gaussians that are all culled."""
    options = Options(1, 1, 0.01, 1e10, 0.3, "RGB", antialiased=False, count_pairs=False)

    def zeros(*shape: int) -> np.ndarray:
        return np.zeros(shape, np.float32)

    cameras = camera_rows(np.eye(4)[None], np.eye(3)[None], options)
    opacities, colors = zeros(1, GROUP), zeros(1, GROUP, channels)
    ellipsoids = Ellipsoids(zeros(1, GROUP, 3), zeros(1, GROUP, 4), zeros(1, GROUP, 3))
    projected = project_stage(ellipsoids, opacities, colors, cameras, options)
    lists = list_stage(projected, options)
    image, alpha = zeros(1, 1, 1, channels), zeros(1, 1, 1, 1)
    drawn = blend_stage(projected, lists, colors, zeros(1, channels), options, image, alpha)
    background_backward_stage(image, drawn.remaining)
    blended = BlendGradients(
        zeros(1, GROUP, 2), zeros(1, GROUP, 3), opacities, zeros(1, GROUP, channels)
    )
    blend_backward_stage(
        projected, lists, opacities, colors, drawn, image, image, alpha, options, blended
    )
    upstream = PlaneGradients(blended.means2d, blended.shapes, zeros(0, 0), zeros(1, GROUP))
    project_backward_stage(ellipsoids, cameras, projected, upstream, options, True, ellipsoids)
