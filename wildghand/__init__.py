"""WildGHand: anti-perturbation Gaussian hand avatars, the reference method of HWP bench.

The names below are loaded when they are first used; `import wildghand` loads neither numpy nor
torch. `docs/python.md` shows them at work.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hwp_bench.base.packages import lazy_names

if TYPE_CHECKING:
    from wildghand.avatar.avatar import WildGHandAvatar as WildGHandAvatar
    from wildghand.avatar.files import load_avatar as load_avatar
    from wildghand.from_video.api import fit as fit
    from wildghand.splat import rasterize as rasterize

_HOMES = {
    "WildGHandAvatar": "wildghand.avatar.avatar",
    "fit": "wildghand.from_video.api",
    "load_avatar": "wildghand.avatar.files",
    "rasterize": "wildghand.splat",
}

__all__ = [*_HOMES]

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
