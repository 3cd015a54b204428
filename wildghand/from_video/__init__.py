"""From a video to an avatar: tracked, imported, fitted, drawn all around, in stages that resume."""

from wildghand.from_video.make import MadeAvatar, make_avatar
from wildghand.from_video.run import VideoFit

__all__ = ["MadeAvatar", "VideoFit", "make_avatar"]
