"""The fixture that makes the small scene."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tiny_scene import SINGLE

from hwp_bench.sim.scene.reader import parse_scene
from hwp_bench.sim.scene.schema import Scene


@pytest.fixture
def make_scene() -> Callable[..., Scene]:
    """Return a function that parses the scene with some of its text replaced."""

    def make(*changes: tuple[str, str]) -> Scene:
        text = SINGLE
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        return parse_scene(text, where="tiny.toml")

    return make
