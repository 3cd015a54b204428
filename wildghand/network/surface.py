"""What the network knows of a hand's surface: where its Gaussians lie, and how they start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.errors import BadInput, ShapeMismatch
from hwp_bench.hands import HandTemplate, SurfaceAnchors, anchor_uv


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """N anchors of one hand at rest."""

    #: (N, 2) texture coordinates in [0, 1], origin at the bottom left.
    uv: Tensor
    #: (N, 3) rest positions, each axis in [-1, 1]; a left hand's are those of its mirror image.
    positions: Tensor
    #: Mean distance between neighbouring anchors, m.
    spacing: float
    #: (3,) sRGB in [0, 1] that the fit starts from: the mean colour of the hand.
    color: Tensor

    def __post_init__(self) -> None:
        count = len(self.uv)
        wanted = {"uv": (count, 2), "positions": (count, 3), "color": (3,)}
        for name, shape in wanted.items():
            tensor = getattr(self, name)
            if tuple(tensor.shape) != shape or count == 0:
                raise ShapeMismatch(f"is {tuple(tensor.shape)}, wanted {shape}", field=name)
            if not bool(torch.isfinite(tensor).all()):
                raise BadInput("holds NaN or infinity", field=name)
        if not (np.isfinite(self.spacing) and self.spacing > 0.0):
            raise BadInput(f"is {self.spacing}", field="spacing")

    def __len__(self) -> int:
        return len(self.uv)


def surface_points(
    template: HandTemplate, anchors: SurfaceAnchors, spacing: float, color: Tensor
) -> SurfacePoints:
    """Describe the anchors of a hand to the network.

    Args:
        template: the hand.
        anchors: N anchors on it.
        spacing: mean distance between neighbouring anchors, m.
        color: (3,) sRGB in [0, 1].

    Returns:
        float32 tensors on the CPU.
    """
    faces = np.asarray(torch.as_tensor(anchors.face_index).cpu())
    mix = np.asarray(torch.as_tensor(anchors.barycentric).cpu(), dtype=np.float64)
    corners = template.vertices[template.faces[faces]]
    positions = (corners * mix[..., None]).sum(axis=1)
    low, high = template.vertices.min(axis=0), template.vertices.max(axis=0)
    positions = (2.0 * positions - low - high) / (high - low)
    if template.side == "left":
        positions[:, 0] *= -1.0
    uv = anchor_uv(template, SurfaceAnchors(faces, mix))
    return SurfacePoints(
        uv=torch.as_tensor(uv, dtype=torch.float32),
        positions=torch.as_tensor(positions, dtype=torch.float32),
        spacing=spacing,
        color=color.detach().float().cpu(),
    )


def mirrored_anchors(anchors: SurfaceAnchors) -> SurfaceAnchors:
    """The same points of the skin on the mirrored hand.

    `mirror_template` keeps the order of the faces and turns each round (last corner first), so
    the barycentric coordinates turn round with them. Anchors that are sampled on the mirrored
    template instead share the faces but lie elsewhere in them.

    Args:
        anchors: of a template or of its mirror image.
    """
    mix = anchors.barycentric
    turned = mix.flip(-1) if isinstance(mix, Tensor) else mix[:, ::-1].copy()
    return SurfaceAnchors(anchors.face_index, turned)
