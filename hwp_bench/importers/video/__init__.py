"""A video of one hand or two and the tracked landmarks: frames, fit, masks, capture."""

from hwp_bench.importers.video.api import finished_import, import_video
from hwp_bench.importers.video.clip import ImportedClip
from hwp_bench.importers.video.decode import FrameRange, parse_frame_range
from hwp_bench.importers.video.solve import FitSettings
from hwp_bench.importers.video.source import VideoImport

__all__ = [
    "FitSettings",
    "FrameRange",
    "ImportedClip",
    "VideoImport",
    "finished_import",
    "import_video",
    "parse_frame_range",
]
