"""The poses of a clip: what an estimator's poses probably err by, told by the poses alone."""

from wildghand.poses.believe import ClipPoses, believed_hands

__all__ = ["ClipPoses", "believed_hands"]
