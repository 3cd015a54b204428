"""The CPU stages as two steps that autograd knows: project, then blend.

Two, so that what lies between, the means on the image plane and the depths, are tensors of the
graph: users of gsplat read the gradient of `info["means2d"]` to densify.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from hwp_bench.errors import HwpError
from wildghand.splat.kernels import geometry
from wildghand.splat.kernels.rows import GROUP
from wildghand.splat.scene import Options, Scene
from wildghand.splat.stages import (
    BlendGradients,
    Drawn,
    Inputs,
    Lists,
    ProjectGradients,
    Projected,
    background_backward_stage,
    blend_backward_stage,
    blend_stage,
    camera_rows,
    list_stage,
    project_backward_stage,
    project_stage,
)


@dataclass
class Call:
    """What one call of `rasterize` keeps for its backward pass; nobody else has it."""

    options: Options
    cameras: np.ndarray
    projected: Projected | None = None
    lists: Lists | None = None
    drawn: Drawn | None = None


def array(tensor: torch.Tensor) -> np.ndarray:
    """A tensor's own memory."""
    return tensor.detach().numpy()


def gaussian_array(tensor: torch.Tensor) -> np.ndarray:
    """A (S, N, ...) tensor's memory; if N is less than the kernels' group, a copy with zeros after.

    A Gaussian of zeros has no rotation, so it is culled.
    """
    missing = GROUP - tensor.shape[1]
    if missing <= 0:
        return array(tensor)
    return np.pad(array(tensor), [(0, 0), (0, missing)] + [(0, 0)] * (tensor.ndim - 2))


def gaussian_zeros(tensor: torch.Tensor) -> torch.Tensor:
    """Zeros for a gradient, with at least as many Gaussians as the kernels' group."""
    size = list(tensor.shape)
    size[1] = max(size[1], GROUP)
    return torch.zeros(size)


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
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(means, quats, scales, viewmats)
        ctx.call = call
        inputs = Inputs(
            *(gaussian_array(tensor) for tensor in (means, quats, scales, opacities, colors)),
            call.cameras,
        )
        projected = project_stage(inputs, call.options)
        call.projected = projected
        count = means.shape[1]
        geom = torch.from_numpy(projected.geom)[:, :count]
        # `shapes` stands for the row's shape and opacity only to carry their gradient back.
        shapes = geom[..., geometry.SHEAR : geometry.SHEAR + 3]
        return (
            geom[..., : geometry.MEAN_Y + 1],
            shapes,
            torch.from_numpy(projected.depths)[:, :count],
            torch.from_numpy(projected.compensations)[:, :count],
        )

    @staticmethod
    def backward(ctx: Any, *upstream: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        refuse_second_order()
        call: Call = ctx.call
        means, quats, scales, viewmats = ctx.saved_tensors
        assert call.projected is not None
        flat = call.projected.depths.shape
        v_means2d, v_shapes, v_depths, v_compensations = (
            None if v is None else gaussian_array(v.contiguous()) for v in upstream
        )
        none = np.zeros((0,), np.float32)
        wanted = [gaussian_zeros(tensor) for tensor in (means, quats, scales)]
        rows = project_backward_stage(
            Inputs(
                *(gaussian_array(tensor) for tensor in (means, quats, scales)),
                none,
                none,
                call.cameras,
            ),
            call.projected,
            np.zeros((*flat, 2), np.float32) if v_means2d is None else v_means2d,
            np.zeros((*flat, 3), np.float32) if v_shapes is None else v_shapes,
            none if v_depths is None else v_depths,
            np.zeros(flat, np.float32) if v_compensations is None else v_compensations,
            call.options,
            ctx.needs_input_grad[3],
            ProjectGradients(*(array(tensor) for tensor in wanted)),
        )
        v_viewmats = None
        if ctx.needs_input_grad[3]:
            v_viewmats = torch.zeros_like(viewmats)
            v_viewmats[:, :3, :3] = torch.from_numpy(rows[:, :9].reshape(-1, 3, 3))
            v_viewmats[:, :3, 3] = torch.from_numpy(rows[:, 9:])
        count = means.shape[1]
        return (*(v[:, :count] for v in wanted), v_viewmats, None, None, None)


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
        ctx.set_materialize_grads(False)
        options = call.options
        assert call.projected is not None
        call.lists = list_stage(call.projected, options)
        shape = (len(backgrounds), options.height, options.width)
        images = torch.empty(*shape, colors.shape[-1])
        alphas = torch.empty(*shape, 1)
        tiles = len(call.lists.start) - 1
        call.drawn = Drawn(
            images=array(images),
            alphas=array(alphas),
            remaining=np.empty(shape, np.float32),
            stops=np.empty(tiles, np.int64),
            pairs=np.empty(tiles, np.int64),
        )
        blend_stage(
            call.projected,
            call.lists,
            gaussian_array(colors),
            array(backgrounds),
            options,
            call.drawn,
        )
        ctx.save_for_backward(opacities, colors, images)
        ctx.call = call
        return images, alphas

    @staticmethod
    def backward(
        ctx: Any, v_images: torch.Tensor | None, v_alphas: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, ...]:
        refuse_second_order()
        call: Call = ctx.call
        opacities, colors, images = ctx.saved_tensors
        assert call.projected is not None and call.lists is not None and call.drawn is not None
        if v_images is None:
            v_images = torch.zeros_like(images)
        if v_alphas is None:
            v_alphas = torch.zeros(*images.shape[:-1], 1)
        up_images, up_alphas = array(v_images.contiguous()), array(v_alphas.contiguous())
        flat = call.projected.depths.shape
        v_means2d, v_shapes = torch.empty(*flat, 2), torch.empty(*flat, 3)
        v_opacities, v_colors = gaussian_zeros(opacities), gaussian_zeros(colors)
        blend_backward_stage(
            call.projected,
            call.lists,
            gaussian_array(opacities),
            gaussian_array(colors),
            call.drawn,
            up_images,
            up_alphas,
            call.options,
            BlendGradients(*(array(v) for v in (v_means2d, v_shapes, v_opacities, v_colors))),
        )
        v_backgrounds = None
        if ctx.needs_input_grad[4]:
            sums = background_backward_stage(up_images, call.drawn.remaining)
            v_backgrounds = torch.from_numpy(sums).float()
        count = opacities.shape[1]
        gradients = (v[:, :count] for v in (v_means2d, v_shapes, v_opacities, v_colors))
        return (*gradients, v_backgrounds, None)


def refuse_second_order() -> None:
    """Double backward is not there; silence would make its result wrong.

    Raises:
        HwpError: the backward pass itself is being recorded (`create_graph=True`).
    """
    if torch.is_grad_enabled():
        raise HwpError(
            "the rasterizer has first derivatives only",
            field="create_graph",
            remedy='Leave create_graph off, or use backend="reference"',
        )


def call_for(scene: Scene) -> Call:
    """A fresh call."""
    cameras = camera_rows(
        scene.viewmats.detach().double().numpy(), scene.Ks.detach().double().numpy(), scene.options
    )
    return Call(scene.options, cameras)
