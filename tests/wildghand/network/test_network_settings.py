"""Settings: every field refuses what makes no sense, by name."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from hwp_bench.base.errors import BadMethod
from hwp_bench.methods.settings import settings_from
from wildghand.network import NetworkSettings, network_settings


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_settings_survive_json(size: str) -> None:
    chosen = network_settings(size)
    assert settings_from(NetworkSettings, chosen.to_json(), "avatar") == chosen


@pytest.mark.parametrize(
    "item",
    [item for item in dataclasses.fields(NetworkSettings) if "range" in item.metadata],
    ids=lambda item: item.name,
)
def test_numbers_beyond_their_range_are_refused(item: dataclasses.Field[Any]) -> None:
    low, high = item.metadata["range"]
    for bad in (low - 1, high + 1, float("nan"), "1", True, None):
        with pytest.raises(BadMethod, match=item.name):
            network_settings("compact", **{item.name: bad})


@pytest.mark.parametrize(
    ("size", "changes", "field"),
    [
        ("huge", {}, "size"),
        ("compact", {"widht": 3}, "widht"),
        ("compact", {"direct": 1}, "direct"),
        ("compact", {"identity_channels": 13}, "identity_channels"),
        ("compact", {"plane_resolution": 42}, "plane_resolution"),
        ("paper", {"plane_width": 500}, "plane_width"),
        ("paper", {"plane_width": 24}, "plane_width"),
    ],
)
def test_settings_that_do_not_fit_together_are_refused(
    size: str, changes: dict[str, Any], field: str
) -> None:
    with pytest.raises(BadMethod, match=field):
        network_settings(size, **changes)
