"""The poses of a clip: what an estimator's poses probably err by, told by the poses alone."""

from wildghand.poses.believe import believed_hands
from wildghand.poses.clip_poses import ClipPoses
from wildghand.poses.settings import PoseSettings

__all__ = ["ClipPoses", "PoseSettings", "believed_hands"]
