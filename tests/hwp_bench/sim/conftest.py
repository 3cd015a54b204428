"""The fixture that makes the small scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from tiny_scene import SINGLE

from hwp_bench.sim.scene.scene import Scene
from hwp_bench.sim.scene_files import parse_scene
from hwp_bench.sim.subject import arms as forearm
from hwp_bench.sim.subject import hand as atlas


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


@pytest.fixture
def small_paintings(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Skin of few texels, for a subject of a test's own: painting a whole one takes 8 seconds.

    At 64 px a sixteenth of the texels is still finer than a pixel. Renders in other processes
    do not see it.
    """
    kept = (atlas.skin_atlas, forearm.arm_atlas)
    monkeypatch.setattr(atlas, "ATLAS", 256)
    monkeypatch.setattr(forearm, "_ARM_TEXELS", (64, 64))
    for function in kept:
        function.cache_clear()
    yield
    for function in kept:
        function.cache_clear()
