"""HWP-Sim: from a scene description to a capture, with everything that a real one hides.

Heavy imports happen when a name is first asked for.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOMES = {
    "Scene": "scene.schema",
    "SuiteItem": "produce.suites",
    "ensure_suite": "produce.suites",
    "load_scene": "scene.reader",
    "render_capture": "produce.production",
    "render_frame": "render.frame",
    "scene_names": "scene.reader",
    "suite": "produce.suites",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
