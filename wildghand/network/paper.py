"""The branches of `paper`: point network, transformer on plane tokens, transposed convolutions."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn
from torch.nn.functional import relu, silu

from wildghand.gaussians.shading import sh_basis, sh_count
from wildghand.network.encoding import encode_pose
from wildghand.network.identity import IdentityMap
from wildghand.network.sampling import CellPooling
from wildghand.network.settings import NetworkSettings
from wildghand.network.surface import COORDINATES, Chart

#: Hidden width of a transformer layer in units of its token width.
EXPANSION = 4
#: Residual blocks (the authors' number).
BLOCKS = 5


class PointPlaneCoder(nn.Module):
    """Points to a plane of tokens, through a transformer, up to finer planes, back to points.

    Args:
        settings: dimensions.
        inputs: channels of a point.
    """

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
        """Features of N Gaussians in B frames: (B, N, channels).

        Args:
            chart: of N Gaussians.
            normals: (B, N, 3) of length 1, world.
            pose: (B, 16, 3) axis-angle, rad.
        """
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

    Args:
        inputs: channels of a point.
        width: hidden channels.
        outputs: channels of a cell.

    Source: the encoder of Peng et al., "Convolutional Occupancy Networks", with means in place
    of maxima, whose gradient reaches all points.
    """

    def __init__(self, inputs: int, width: int, outputs: int) -> None:
        super().__init__()
        self.enter = nn.Linear(inputs, 2 * width)
        self.blocks = nn.ModuleList(ResidualBlock(2 * width, width) for _ in range(BLOCKS))
        self.leave = nn.Linear(width, outputs)

    def forward(self, points: Tensor, cells: CellPooling) -> tuple[Tensor, Tensor]:
        """Encode points.

        Args:
            points: (B, N, inputs).
            cells: which cell each point lies in.

        Returns:
            (B, N, width) features of the points and (B, cells, outputs) of the cells.
        """
        features = self.blocks[0](self.enter(points))
        for block in self.blocks[1:]:
            around = _pooled(features, cells)[:, cells.cell]
            features = block(torch.cat((features, around), dim=-1))
        return features, _pooled(self.leave(features), cells)


def _pooled(features: Tensor, cells: CellPooling) -> Tensor:
    return torch.stack([cells(frame) for frame in features])
