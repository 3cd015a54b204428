"""Tracking of hands: from a video to the landmarks of one or two hands."""

from hwp_bench.tracking.networks import fetch_models
from hwp_bench.tracking.track_video import TrackedVideo, TrackerSettings, track_video

__all__ = ["TrackedVideo", "TrackerSettings", "fetch_models", "track_video"]
