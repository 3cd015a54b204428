"""The network's parameters: in groups with rates of their own, and layer by layer."""

from __future__ import annotations

import re
from dataclasses import dataclass

import torch
from torch import nn

from wildghand.network.network import PredictionNetwork
from wildghand.network.settings import NetworkSettings
from wildghand.network.surface import SurfacePoints


def parameter_groups(network: PredictionNetwork) -> dict[str, list[nn.Parameter]]:
    """Sort every parameter into one of five groups.

    Returns:
        `identity`: the identity map; `direct`: the matrix that adds it to the attributes (empty
        without `direct`); `light`: the linear part of head (ii); `refinement`: head (iv);
        `network`: all others. Groups and their members are in a fixed order.
    """
    groups: dict[str, list[nn.Parameter]] = {
        "identity": [],
        "direct": [],
        "light": [],
        "refinement": [],
        "network": [],
    }
    prefixes = {
        "identity.": "identity",
        "attribute_head.direct.": "direct",
        "shadow_head.light.": "light",
        "refinement_head.": "refinement",
    }
    for name, parameter in network.named_parameters():
        group = next((g for prefix, g in prefixes.items() if name.startswith(prefix)), "network")
        groups[group].append(parameter)
    return groups


@dataclass(frozen=True)
class LayerRow:
    """A layer, or several of the same kind."""

    #: Path in the network; `*` stands for the number of a repeated layer.
    layer: str
    #: Shapes of its weights, in the order in which torch holds them.
    weights: str
    #: Parameters of one of them.
    each: int
    #: How many there are.
    times: int

    @property
    def parameters(self) -> int:
        """Parameters of all of them."""
        return self.each * self.times

    @property
    def part(self) -> str:
        """Which part of the network it belongs to: the first name of the path."""
        return self.layer.partition(".")[0]


def parameter_table(network: PredictionNetwork) -> tuple[LayerRow, ...]:
    """List every layer that learns; repeated layers of equal shape share a row.

    Returns:
        Rows in the network's order; their `parameters` add up to all there are.
    """
    counted: dict[tuple[str, str, int], int] = {}
    for path, module in network.named_modules():
        own = list(module.parameters(recurse=False))
        if own:
            layer = re.sub(r"\.\d+\.", ".*.", path)
            weights = " + ".join("x".join(map(str, tensor.shape)) for tensor in own)
            key = (layer, weights, sum(tensor.numel() for tensor in own))
            counted[key] = counted.get(key, 0) + 1
    return tuple(LayerRow(*key, times) for key, times in counted.items())


def blank_network(settings: NetworkSettings) -> PredictionNetwork:
    """A network of both hands without memory for its weights: enough to count them."""
    dot = SurfacePoints(
        uv=torch.full((1, 2), 0.5),
        positions=torch.zeros(1, 3),
        spacing=1e-3,
        color=torch.full((3,), 0.5),
    )
    with torch.device("meta"):
        return PredictionNetwork(settings, {"left": dot, "right": dot})
