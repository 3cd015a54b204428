"""The shadow network: from pose and view to one number for each anchor."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from wildghand.network.surface import CellPooling, PlaneSampler

_WIDTH = 16
# Axis-angle of fifteen joints, and two columns of the wrist's rotation.
_POSE = 45 + 6
# Before the sigmoid: most of the skin is in the light.
_LIT = 2.0


class ShadowNet(nn.Module):
    """Three convolutions over the texture plane; one sigmoid channel.

    Args:
        uv: (N, 2) the anchors' texture coordinates, in [0, 1].
        channels: of what is known of each anchor in a frame.
        cells: along an edge of the plane.
    """

    coordinates: Tensor

    def __init__(self, uv: Tensor, channels: int, cells: int) -> None:
        super().__init__()
        self._cells = cells
        self._pool = CellPooling(uv, cells)
        self._read = PlaneSampler(uv, cells)
        known = torch.cat((2.0 * uv - 1.0, torch.ones(len(uv), 1)), dim=-1)
        self.register_buffer("coordinates", self._planes(known[None]), persistent=False)
        self.first = nn.Conv2d(channels + known.shape[1], _WIDTH, 3, padding=1)
        self.pose = nn.Linear(_POSE, _WIDTH, bias=False)
        self.second = nn.Conv2d(_WIDTH, _WIDTH, 3, padding=1)
        self.last = nn.Conv2d(_WIDTH, 1, 3, padding=1)
        with torch.no_grad():
            # The wrist's turns reach further than those of fingers; neither may drown the view.
            self.pose.weight.mul_(0.3)
            self.last.weight.mul_(0.1)
            assert self.last.bias is not None
            self.last.bias.fill_(_LIT)

    def _planes(self, values: Tensor) -> Tensor:
        """(B, N, C) to (B, C, cells, cells), means over the anchors of each cell."""
        frames, count, channels = values.shape
        means = self._pool(values.permute(1, 0, 2).reshape(count, frames * channels))
        return means.reshape(self._cells, self._cells, frames, channels).permute(2, 3, 0, 1)

    def forward(self, known: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the shadows of B frames.

        Args:
            known: (B, N, channels) of each anchor, such as how it faces the camera.
            pose: (B, 16, 3) axis-angle, rad.

        Returns:
            (B, N) in (0, 1), 1 is full light; and the plane that they are read from,
            (B, 1, cells, cells).
        """
        frames = len(known)
        planes = torch.cat(
            (self._planes(known), self.coordinates.expand(frames, -1, -1, -1)), dim=1
        )
        turned = torch.cat((pose[:, 1:].flatten(1), _two_columns(pose[:, 0])), dim=-1)
        hidden = leaky_relu(self.first(planes) + self.pose(turned)[..., None, None], 0.1)
        plane = self.last(leaky_relu(self.second(hidden), 0.1)).sigmoid()
        rows = plane.reshape(frames, -1).mT.contiguous()
        return self._read(rows).mT, plane


def _two_columns(axis_angle: Tensor) -> Tensor:
    """(B, 3) axis-angle to the first two columns of the rotations, (B, 6): no jump at a turn."""
    angle = axis_angle.norm(dim=-1, keepdim=True).clamp(min=1e-8)
    axis = axis_angle / angle
    x, y, z = axis.unbind(dim=-1)
    none = torch.zeros_like(x)
    cross = torch.stack((none, -z, y, z, none, -x, -y, x, none), dim=-1).reshape(-1, 3, 3)
    sine, cosine = angle.sin()[..., None], angle.cos()[..., None]
    rotation = torch.eye(3).to(axis) + sine * cross + (1.0 - cosine) * (cross @ cross)
    return rotation[..., :2].flatten(1)
