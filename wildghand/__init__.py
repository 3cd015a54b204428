"""WildGHand: anti-perturbation Gaussian hand avatars, the reference method of HWP bench.

The names below are loaded when they are first used; `import wildghand` loads neither numpy nor
torch. `docs/python.md` shows them at work.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wildghand.avatar.avatar import WildGHandAvatar as WildGHandAvatar
    from wildghand.avatar.files import load_avatar as load_avatar
    from wildghand.fitting.api import fit as fit
    from wildghand.splat import rasterize as rasterize

_HOMES = {
    "WildGHandAvatar": "wildghand.avatar.avatar",
    "fit": "wildghand.fitting.api",
    "load_avatar": "wildghand.avatar.files",
    "rasterize": "wildghand.splat",
}

__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
