"""The branches: `compact` convolves a small plane, `paper` is a point network and a transformer."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, relu, silu

from wildghand.gaussians.shading import sh_basis, sh_count
from wildghand.network.heads import IdentityMap
from wildghand.network.settings import NetworkSettings
from wildghand.network.surface import COORDINATES, CellPooling, Chart, encode_pose


class PlaneCoder(nn.Module):
    """Encoder and decoder on a UV plane, three scales deep, with skips.

    `width` channels come out; there are twice as many at the two coarser scales.
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
        """(B, N, channels) of (B, N, 3) unit normals and (B, 16, 3) rad, harmonics first."""
        # The constant harmonic is the bias of whatever reads them.
        light = sh_basis(normals, self.degree)[..., 1:]
        place = self.place(chart.coordinates.to(light.dtype))
        posture = self.pose(encode_pose(pose, self.frequencies))
        hidden = silu(place + self.normal(light) + posture[:, None])
        return torch.cat((light, silu(self.mix(hidden))), dim=-1)


def _twice(plane: Tensor) -> Tensor:
    return interpolate(plane, scale_factor=2.0, mode="nearest")


#: Hidden width of a transformer layer in units of its token width.
EXPANSION = 4
#: Residual blocks (the authors' number).
BLOCKS = 5


class PointPlaneCoder(nn.Module):
    """Points to a plane of tokens, through a transformer, up to finer planes, back to points."""

    def __init__(self, settings: NetworkSettings, inputs: int) -> None:
        super().__init__()
        width = settings.plane_width
        self.resolution = settings.plane_resolution
        self.points = LocalPointNet(inputs, settings.point_width, width)
        self.position = nn.Parameter(0.02 * torch.randn(self.resolution**2, width))
        layer = nn.TransformerEncoderLayer(
            width,
            settings.attention_heads,
            dim_feedforward=EXPANSION * width,
            dropout=0.0,
            activation="gelu",
            batch_first=True,
            norm_first=True,
        )
        self.transformer = nn.TransformerEncoder(
            layer,
            settings.transformer_layers,
            norm=nn.LayerNorm(width),
            enable_nested_tensor=False,
        )
        widths = [width // factor for factor in (1, 2, 4, 8, 16)]
        self.ups = nn.ModuleList(
            nn.ConvTranspose2d(before, after, 4, stride=2, padding=1)
            for before, after in itertools.pairwise(widths)
        )
        #: Length of the features.
        self.channels = sum(widths[1:]) + settings.point_width

    def forward(self, points: Tensor, chart: Chart) -> Tensor:
        """(B, N, inputs) to (B, N, channels)."""
        skip, tokens = self.points(points, chart.cells)
        tokens = self.transformer(tokens + self.position)
        plane = tokens.transpose(1, 2).unflatten(2, (self.resolution, self.resolution))
        read = []
        for up, sampler in zip(self.ups, chart.planes, strict=True):
            plane = silu(up(plane))
            rows = plane.flatten(2).transpose(1, 2)
            read.append(torch.stack([sampler(frame) for frame in rows]))
        return torch.cat((*read, skip), dim=-1)


class PaperTexture(nn.Module):
    """Texture branch: uv, positional encoding and identity features of each Gaussian."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.coder = PointPlaneCoder(settings, COORDINATES + settings.identity_channels)
        #: Length of the features.
        self.channels = self.coder.channels

    def forward(self, chart: Chart, identity: IdentityMap, side: str) -> Tensor:
        """Features of N Gaussians: (N, channels)."""
        latent = chart.identity(identity(side))
        points = torch.cat((chart.coordinates.to(latent.dtype), latent), dim=-1)
        return self.coder(points[None], chart)[0]


class PaperGeometry(nn.Module):
    """Geometry branch: uv, positional encoding, pose embedding and posed normals.

    The normals (as spherical harmonics) are ours: shading needs them.
    """

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.degree = settings.shading_degree
        self.frequencies = settings.pose_frequencies
        harmonics = sh_count(self.degree) - 1
        self.coder = PointPlaneCoder(settings, COORDINATES + 96 * self.frequencies + harmonics)
        #: Length of the features.
        self.channels = self.coder.channels

    def forward(self, chart: Chart, normals: Tensor, pose: Tensor) -> Tensor:
        """(B, N, channels) of (B, N, 3) unit normals and (B, 16, 3) rad."""
        batch, count = normals.shape[:2]
        light = sh_basis(normals, self.degree)[..., 1:]
        place = chart.coordinates.to(light.dtype).expand(batch, -1, -1)
        posture = encode_pose(pose, self.frequencies)[:, None].expand(-1, count, -1)
        return self.coder(torch.cat((place, posture, light), dim=-1), chart)


class ResidualBlock(nn.Module):
    """Two linear layers next to a straight one; `inputs` and `width` channels."""

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.first = nn.Linear(inputs, width)
        self.second = nn.Linear(width, width)
        self.straight = nn.Linear(inputs, width, bias=False)

    def forward(self, features: Tensor) -> Tensor:
        """(..., inputs) to (..., width)."""
        return self.straight(features) + self.second(relu(self.first(relu(features))))


class LocalPointNet(nn.Module):
    """Local-pooling PointNet.

    After each block the mean over a point's cell is appended to its own features.

    Source: the encoder of Peng et al., "Convolutional Occupancy Networks", with means in place of
    maxima, whose gradient reaches all points.
    """

    def __init__(self, inputs: int, width: int, outputs: int) -> None:
        super().__init__()
        self.enter = nn.Linear(inputs, 2 * width)
        self.blocks = nn.ModuleList(ResidualBlock(2 * width, width) for _ in range(BLOCKS))
        self.leave = nn.Linear(width, outputs)

    def forward(self, points: Tensor, cells: CellPooling) -> tuple[Tensor, Tensor]:
        """(B, N, inputs) to (B, N, width) of the points and (B, cells, outputs) of the cells."""
        features = self.blocks[0](self.enter(points))
        for block in self.blocks[1:]:
            around = _pooled(features, cells)[:, cells.cell]
            features = block(torch.cat((features, around), dim=-1))
        return features, _pooled(self.leave(features), cells)


def _pooled(features: Tensor, cells: CellPooling) -> Tensor:
    return torch.stack([cells(frame) for frame in features])
