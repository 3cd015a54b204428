"""The Gaussian prediction network, in two sizes: `compact` and `paper`."""

from wildghand.network.network import (
    HandFeatures,
    NetworkOutput,
    PredictionNetwork,
    Refinement,
    parameter_groups,
)
from wildghand.network.settings import NetworkSettings, network_settings
from wildghand.network.surface import SurfacePoints, mirrored_anchors, surface_points

__all__ = [
    "HandFeatures",
    "NetworkOutput",
    "NetworkSettings",
    "PredictionNetwork",
    "Refinement",
    "SurfacePoints",
    "mirrored_anchors",
    "network_settings",
    "parameter_groups",
    "surface_points",
]
