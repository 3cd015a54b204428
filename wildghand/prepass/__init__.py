"""The pre-pass: judges training frames before the fit; no network, about a second.

The names are imported when they are first asked for, so that importing this package loads no
torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wildghand.prepass.judge import PrepassInput, judge_capture, judge_frames
    from wildghand.prepass.judgement import Judgement
    from wildghand.prepass.settings import PrepassSettings

__all__ = ["Judgement", "PrepassInput", "PrepassSettings", "judge_capture", "judge_frames"]

_HOMES = {
    "Judgement": "judgement",
    "PrepassInput": "judge",
    "PrepassSettings": "settings",
    "judge_capture": "judge",
    "judge_frames": "judge",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
