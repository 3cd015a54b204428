"""Shapes of a network's weights, to compare files with before memory is taken for them."""

from __future__ import annotations

import torch

from wildghand.network.network import PredictionNetwork
from wildghand.network.parameters import blank_network
from wildghand.network.settings import NetworkSettings

#: Start of the names of identity maps in a network's state.
MAPS = "identity.maps."


def shapes_of(network: PredictionNetwork) -> dict[str, torch.Size]:
    """Shapes of all weights of a network, and of the identity maps of both hands."""
    shapes = {name: value.shape for name, value in network.state_dict().items()}
    of_map = next(shape for name, shape in shapes.items() if name.startswith(MAPS))
    return shapes | {f"{MAPS}{side}": of_map for side in ("right", "left")}


def shapes_of_settings(settings: NetworkSettings) -> dict[str, torch.Size]:
    """The same where there is no network yet; the first time takes a second."""
    return shapes_of(blank_network(settings))
