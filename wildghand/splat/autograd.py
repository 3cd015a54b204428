"""The CPU stages as two steps that autograd knows: project, then blend.

They are two so that the means on the image plane and the depths are tensors of the graph: users of
gsplat read the gradient of `info["means2d"]` to densify.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from hwp_bench.base.errors import HwpError
from wildghand.splat.backward_stages import (
    background_backward_stage,
    blend_backward_stage,
    project_backward_stage,
)
from wildghand.splat.kernels import geometry
from wildghand.splat.kernels.project import Ellipsoids, Projected
from wildghand.splat.kernels.project_backward import PlaneGradients
from wildghand.splat.kernels.reduce import BlendGradients
from wildghand.splat.kernels.rows import GROUP
from wildghand.splat.scene import Options
from wildghand.splat.stages import (
    Drawn,
    Lists,
    blend_stage,
    list_stage,
    project_stage,
)


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
            geom[..., geometry.MEAN_X : geometry.MEAN_Y + 1],
            geom[..., geometry.SHEAR : geometry.SHEAR + 3],
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
