"""The branches of `compact`: convolutions on a small plane, and a shallow geometry branch."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, silu

from wildghand.gaussians.shading import sh_basis, sh_count
from wildghand.network.encoding import encode_pose
from wildghand.network.identity import IdentityMap
from wildghand.network.settings import NetworkSettings
from wildghand.network.surface import COORDINATES, Chart


class PlaneCoder(nn.Module):
    """Encoder and decoder on a UV plane, three scales deep, with skips.

    Args:
        inputs: channels in.
        width: channels out; twice as many at the two coarser scales.
    """

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.enter = nn.Conv2d(inputs, width, 3, padding=1)
        self.down = nn.Conv2d(width, 2 * width, 3, stride=2, padding=1)
        self.bottom = nn.Conv2d(2 * width, 2 * width, 3, stride=2, padding=1)
        self.up = nn.Conv2d(4 * width, 2 * width, 3, padding=1)
        self.leave = nn.Conv2d(3 * width, width, 3, padding=1)

    def forward(self, plane: Tensor) -> Tensor:
        """(1, inputs, P, P) to (1, width, P, P), P a multiple of 4."""
        fine = silu(self.enter(plane))
        middle = silu(self.down(fine))
        coarse = silu(self.bottom(middle))
        middle = silu(self.up(torch.cat((middle, _twice(coarse)), dim=1)))
        return silu(self.leave(torch.cat((fine, _twice(middle)), dim=1)))


class CompactTexture(nn.Module):
    """Texture branch: the identity features of each Gaussian, and what its surroundings hold."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.resolution = settings.plane_resolution
        self.coder = PlaneCoder(settings.identity_channels + COORDINATES, settings.plane_width)
        #: Length of the features.
        self.channels = settings.identity_channels + settings.plane_width

    def forward(self, chart: Chart, identity: IdentityMap, side: str) -> Tensor:
        """Features of N Gaussians: (N, channels), the identity features first."""
        latent = chart.identity(identity(side))
        cells = torch.cat((chart.cells(latent), chart.cell_coordinates.to(latent.dtype)), dim=-1)
        edges = (self.resolution, self.resolution)
        plane = self.coder(cells.T.unflatten(1, edges)[None])
        around = chart.planes[0](plane[0].flatten(1).T)
        return torch.cat((latent, around), dim=-1)


class CompactGeometry(nn.Module):
    """Geometry branch: place, posed normal and pose of each Gaussian through one hidden layer.

    The spherical harmonics of the normal are passed on too, so that a linear head sees
    light on a matte surface as what it is.
    """

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.degree = settings.shading_degree
        self.frequencies = settings.pose_frequencies
        harmonics = sh_count(self.degree) - 1
        width = settings.point_width
        # One linear layer on [place, normal, pose], taken apart: the place has no frames, the
        # pose no Gaussians.
        self.place = nn.Linear(COORDINATES, width)
        self.normal = nn.Linear(harmonics, width, bias=False)
        self.pose = nn.Linear(96 * self.frequencies, width, bias=False)
        self.mix = nn.Linear(width, width)
        #: Length of the features.
        self.channels = harmonics + width

    def forward(self, chart: Chart, normals: Tensor, pose: Tensor) -> Tensor:
        """Features of N Gaussians in B frames: (B, N, channels), harmonics first.

        Args:
            chart: of N Gaussians.
            normals: (B, N, 3) of length 1, world.
            pose: (B, 16, 3) axis-angle, rad.
        """
        # The constant harmonic is the bias of whatever reads them.
        light = sh_basis(normals, self.degree)[..., 1:]
        place = self.place(chart.coordinates.to(light.dtype))
        posture = self.pose(encode_pose(pose, self.frequencies))
        hidden = silu(place + self.normal(light) + posture[:, None])
        return torch.cat((light, silu(self.mix(hidden))), dim=-1)


def _twice(plane: Tensor) -> Tensor:
    return interpolate(plane, scale_factor=2.0, mode="nearest")
