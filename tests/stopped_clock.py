"""A clock that stands still unless a test tells it to go on."""

from __future__ import annotations

from types import SimpleNamespace

import pytest


class Clock:
    """Seconds."""

    now = 100.0


def stop_clock(monkeypatch: pytest.MonkeyPatch, *modules: str) -> Clock:
    """Replace the clock that modules look at; they import `time` as a whole."""
    made = Clock()
    stopped = SimpleNamespace(perf_counter=lambda: made.now)
    for module in modules:
        monkeypatch.setattr(f"{module}.time", stopped)
    return made
