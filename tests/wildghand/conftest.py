"""Fixtures for the tests of the method."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tiny_fits import TINY

import wildghand
from hwp_bench.capture import Capture
from wildghand.avatar.avatar import WildGHandAvatar


@pytest.fixture(scope="session")
def tiny_avatar(make_painted: Callable[..., Capture]) -> WildGHandAvatar:
    """An avatar of the painted right hand, as a few steps leave it."""
    return wildghand.fit(
        make_painted().root, settings={**TINY, "gaussians": 1500}, steps=12, all_frames=True
    )
