"""Light beyond what a clip shows: colours at normals that no training frame has faced."""

from wildghand.light.known_light import KnownLight, LightSamples, fit_light
from wildghand.light.settings import LightSettings

__all__ = ["KnownLight", "LightSamples", "LightSettings", "fit_light"]
