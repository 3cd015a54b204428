"""The poses of a clip: the probable errors of an estimator's poses, found from the poses alone."""

from wildghand.poses.believe import ClipPoses, believed_hands

__all__ = ["ClipPoses", "believed_hands"]
