"""A video of one hand or two and the tracked landmarks: frames, fit, masks, capture."""

from hwp_bench.importers.video.api import ImportedClip, import_video, read_finished_import
from hwp_bench.importers.video.decode import FrameRange, parse_frame_range
from hwp_bench.importers.video.solve import SolveSettings
from hwp_bench.importers.video.source import VideoImport

__all__ = [
    "FrameRange",
    "ImportedClip",
    "SolveSettings",
    "VideoImport",
    "import_video",
    "parse_frame_range",
    "read_finished_import",
]
