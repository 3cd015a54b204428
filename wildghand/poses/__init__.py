"""The poses of a clip: what an estimator's poses probably err by, told by the poses alone."""

from wildghand.poses.believe import ClipPoses, believed_hands
from wildghand.poses.errors import PoseSettings

__all__ = ["ClipPoses", "PoseSettings", "believed_hands"]
