"""Fixtures for the tests of the method."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

import wildghand
from hwp_bench.capture import Capture
from wildghand.avatar.avatar import WildGHandAvatar

#: Settings of a fit that takes seconds.
TINY: dict[str, Any] = {
    "gaussians": 1500,
    "network.identity_resolution": 24,
    "network.plane_resolution": 12,
    "device": "cpu",
}


@pytest.fixture(scope="session")
def tiny_avatar(make_painted: Callable[..., Capture]) -> WildGHandAvatar:
    """An avatar of the painted right hand, as a few steps leave it."""
    return wildghand.fit(make_painted().root, settings=TINY, steps=12, all_frames=True)
