"""A prior over subjects: the weights that a fit starts from in place of random ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from hwp_bench.base.errors import BadInput
from hwp_bench.base.records import Count, Seed
from wildghand.network import PredictionNetwork
from wildghand.network.network import MAPS


@dataclass(frozen=True)
class PriorRecord:
    """Description of a prior, and how it was made."""

    #: Version of the folder.
    schema: str
    #: `name`, `digest` and `source` of the hand model.
    hand_model: dict[str, str]
    #: Hands that have an identity map.
    sides: list[str]
    #: `wildghand.network.NetworkSettings` of its network.
    network: dict[str, Any]
    #: The captures that it was fitted to: `id`, `digest`, `hands` and `source` of each capture.
    captures: list[dict[str, Any]]
    #: All settings of that fit.
    settings: dict[str, Any]
    #: Its seed.
    seed: Seed
    #: Its optimizer steps.
    steps: Count
    #: SHA-256 of the file of weights, hex.
    weights: str


@dataclass(frozen=True, eq=False)
class Prior:
    """A prior, checked."""

    record: PriorRecord
    #: A network's state: shared weights, and the mean identity map of each hand that was seen.
    tensors: Mapping[str, Tensor]

    def initialise(self, network: PredictionNetwork) -> None:
        """Put the prior in place of a network's weights.

        A hand that the prior has not seen starts from the other hand's map: the two halves of
        the atlas hold the same skin at the same places.

        Args:
            network: with the settings of the prior's.
        """
        state = dict(self.tensors)
        maps = {side: state.pop(f"{MAPS}{side}") for side in self.record.sides}
        for side in network.identity.maps:
            state[f"{MAPS}{side}"] = maps.get(side, next(iter(maps.values())))
        network.load_state_dict(state, strict=True)


def mean_weights(networks: Iterable[PredictionNetwork]) -> dict[str, Tensor]:
    """Weights that networks of several subjects with shared branches and heads have in common.

    Args:
        networks: they differ in their identity maps only.

    Returns:
        The shared weights, and for each hand the mean of the maps there are of it; float32, CPU.
    """
    shared: dict[str, Tensor] = {}
    maps: dict[str, list[Tensor]] = {}
    for network in networks:
        for name, value in network.state_dict().items():
            value = value.detach().float().cpu()
            if name.startswith(MAPS):
                maps.setdefault(name, []).append(value)
            else:
                shared[name] = value
    return {**shared, **{name: torch.stack(values).mean(dim=0) for name, values in maps.items()}}


def check_tensors(
    tensors: Mapping[str, Tensor], sides: Iterable[str], shapes: Mapping[str, torch.Size]
) -> None:
    """Refuse tensors that are not the weights of a network.

    Args:
        tensors: by name.
        sides: hands that should have an identity map.
        shapes: of the network's weights, with the maps of both hands.

    Raises:
        BadInput: one is missing, too many, of another shape, no float, or not finite; it is named.
    """
    absent = {f"{MAPS}{side}" for side in ("right", "left") if side not in sides}
    expected = {name: shape for name, shape in shapes.items() if name not in absent}
    for name in sorted(expected.keys() ^ tensors.keys()):
        raise BadInput("is missing" if name in expected else "is not known", field=name[:100])
    for name, value in tensors.items():
        if value.shape != expected[name]:
            raise BadInput(
                f"is {tuple(value.shape)}, not {tuple(expected[name])}"[:200], field=name
            )
        if not value.is_floating_point():
            raise BadInput(f"holds {value.dtype}, not floating point", field=name)
        if not bool(value.isfinite().all()):
            raise BadInput("holds NaN or infinity", field=name)
