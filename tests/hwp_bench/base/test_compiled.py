"""Compiling leaves Python's collector of garbage as it was; oracle: what the collector says."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from typing import Any

import pytest
from numba.core import event
from numba.core.errors import TypingError

from hwp_bench.base.kernels import compiled


@pytest.fixture(autouse=True)
def _collector() -> Iterator[None]:
    on = gc.isenabled()
    yield
    (gc.enable if on else gc.disable)()


class _Seen(event.Listener):  # type: ignore[misc]
    """Whether the collector is on where numba starts to compile."""

    def __init__(self) -> None:
        self.on: list[bool] = []

    def on_start(self, event: Any) -> None:
        self.on.append(gc.isenabled())

    def on_end(self, event: Any) -> None:
        pass


@pytest.mark.parametrize("on", [True, False])
def test_the_collector_rests_while_a_kernel_is_compiled(on: bool) -> None:
    @compiled()
    def double(x: Any) -> Any:
        return x + x

    (gc.enable if on else gc.disable)()
    seen = _Seen()
    with event.install_listener("numba:compile", seen):
        assert double(2) == 4
    assert seen.on == [False]
    assert gc.isenabled() == on


def test_a_kernel_that_cannot_be_compiled_leaves_it_on() -> None:
    @compiled()
    def impossible(x: Any) -> Any:
        return x + "one"

    gc.enable()
    with pytest.raises(TypingError):
        impossible(2)
    assert gc.isenabled()
