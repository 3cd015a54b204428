"""The network's parameters by what they do, for learning rates of their own."""

from __future__ import annotations

from torch import nn

from wildghand.network.network import PredictionNetwork


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
