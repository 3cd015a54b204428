"""A point network whose points talk to each other through the cells of a UV plane."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import relu

from wildghand.network.sampling import CellPooling

#: Residual blocks (the authors' number).
BLOCKS = 5


class ResidualBlock(nn.Module):
    """Two linear layers beside a straight one; `inputs` and `width` channels."""

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

    After each block the mean over a point's cell is put beside its own features.

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
