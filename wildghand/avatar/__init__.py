"""The fitted avatar: drawing, files, clips."""

from wildghand.avatar.avatar import FitRecord, PosedGaussians, WildGHandAvatar
from wildghand.avatar.files import load_avatar, save_avatar

__all__ = ["FitRecord", "PosedGaussians", "WildGHandAvatar", "load_avatar", "save_avatar"]
