"""Light: beyond what a clip shows, and where hands keep it from themselves and from each other."""

from wildghand.light.hand_shadows import HandShadows, Obstacles, ShadowTable, obstacles_in_frames
from wildghand.light.light import CastLight, KnownLight, LightSamples, find_light, fit_light

__all__ = [
    "CastLight",
    "HandShadows",
    "KnownLight",
    "LightSamples",
    "Obstacles",
    "ShadowTable",
    "find_light",
    "fit_light",
    "obstacles_in_frames",
]
