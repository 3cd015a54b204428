"""The hand model: parameters, templates, skinning, surface anchors, projection.

Torch is imported only when a name that needs it is asked for.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOMES = {
    "HandParameters": "parameters",
    "HandTemplate": "template",
    "PosedHand": "skinning",
    "TemplateTensors": "skinning",
    "landmark_order": "landmarks",
    "load_template": "sources",
    "mirror_template": "template",
    "pose_hand": "skinning",
    "project": "camera",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
