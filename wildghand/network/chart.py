"""The fixed side of one hand's surface: its coordinates, and samplers of every plane."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from wildghand.network.encoding import POSITION_CHANNELS, encode_positions
from wildghand.network.sampling import CellPooling, PlaneSampler
from wildghand.network.settings import NetworkSettings
from wildghand.network.surface import SurfacePoints

#: Channels of `Chart.coordinates`: uv and the encoded rest position.
COORDINATES = 2 + POSITION_CHANNELS


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
