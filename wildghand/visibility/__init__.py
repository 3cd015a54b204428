"""Visibility: how much training frames say of each Gaussian, and what holds where they do not."""

from wildghand.visibility.count import never_shown, shown_frames
from wildghand.visibility.visibility import (
    ColorChanges,
    Visibility,
    VisibilitySettings,
    fill_shares,
    kept_share,
    strengths,
    weigh_visibility,
)

__all__ = [
    "ColorChanges",
    "Visibility",
    "VisibilitySettings",
    "fill_shares",
    "kept_share",
    "never_shown",
    "shown_frames",
    "strengths",
    "weigh_visibility",
]
