"""Light: beyond what a clip shows, and where hands keep it from themselves and from each other."""

from wildghand.light.fit_lights import (
    KnownLight,
    LightSamples,
    ShadowSamples,
    find_light,
    fit_light,
)
from wildghand.light.hand_shadows import HandShadows, Obstacles, ShadowTable, obstacles_in_frames
from wildghand.light.lights import CastLight

__all__ = [
    "CastLight",
    "HandShadows",
    "KnownLight",
    "LightSamples",
    "Obstacles",
    "ShadowSamples",
    "ShadowTable",
    "find_light",
    "fit_light",
    "obstacles_in_frames",
]
