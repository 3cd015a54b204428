"""The fixed side of one hand's surface: where its Gaussians lie, and samplers of every plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from hwp_bench.base.errors import BadInput, ShapeMismatch
from hwp_bench.hands import HandTemplate, SurfaceAnchors, anchor_uv
from wildghand.network.encoding import POSITION_CHANNELS, encode_positions
from wildghand.network.sampling import CellPooling, PlaneSampler
from wildghand.network.settings import NetworkSettings

#: Channels of `Chart.coordinates`: uv and the encoded rest position.
COORDINATES = 2 + POSITION_CHANNELS


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
        expected = {"uv": (count, 2), "positions": (count, 3), "color": (3,)}
        for name, shape in expected.items():
            tensor = getattr(self, name)
            if tuple(tensor.shape) != shape or count == 0:
                raise ShapeMismatch(f"is {tuple(tensor.shape)}, not {shape}", field=name)
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


def plane_resolutions(settings: NetworkSettings) -> tuple[int, ...]:
    """Edges of the planes that features are read from, in cells."""
    if settings.size == "compact":
        return (settings.plane_resolution,)
    return tuple(settings.plane_resolution * factor for factor in (2, 4, 8, 16))


class Chart(nn.Module):
    """Everything about N anchors that does not change. Nothing here is learned or saved.

    Args:
        settings: resolutions.
        surface: the anchors.
    """

    coordinates: Tensor

    def __init__(self, settings: NetworkSettings, surface: SurfacePoints) -> None:
        super().__init__()
        coordinates = torch.cat(
            (2.0 * surface.uv - 1.0, encode_positions(surface.positions)), dim=-1
        )
        self.register_buffer("coordinates", coordinates, persistent=False)
        self.identity = PlaneSampler(surface.uv, settings.identity_resolution)
        self.planes = nn.ModuleList(
            PlaneSampler(surface.uv, resolution) for resolution in plane_resolutions(settings)
        )
        self.cells = CellPooling(surface.uv, settings.plane_resolution)
        cell_coordinates = self.cells(coordinates)
        self.register_buffer("cell_coordinates", cell_coordinates, persistent=False)

    cell_coordinates: Tensor

    def __len__(self) -> int:
        return len(self.coordinates)
