"""A video of one hand or two and the tracked landmarks: frames, fit, masks, capture."""

from hwp_bench.importers.video.from_video import finished_import, import_video
from hwp_bench.importers.video.imported_clip import ImportedClip
from hwp_bench.importers.video.video_settings import (
    FitSettings,
    FrameRange,
    VideoImport,
    parse_frame_range,
)

__all__ = [
    "FitSettings",
    "FrameRange",
    "ImportedClip",
    "VideoImport",
    "finished_import",
    "import_video",
    "parse_frame_range",
]
