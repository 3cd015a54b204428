"""Shadows that hands cast on themselves and on each other, under a light that the frames tell."""

from wildghand.shadows.cast_light import CastLight
from wildghand.shadows.find_light import ShadowSamples, find_light
from wildghand.shadows.hand_shadows import HandShadows, ShadowTable
from wildghand.shadows.obstacles import Obstacles, obstacles_in_frames
from wildghand.shadows.settings import ShadowSettings

__all__ = [
    "CastLight",
    "HandShadows",
    "Obstacles",
    "ShadowSamples",
    "ShadowSettings",
    "ShadowTable",
    "find_light",
    "obstacles_in_frames",
]
