"""The capture on disk: writer, checking reader, check, contact sheet."""

from hwp_bench.capture.reader import Capture, open_capture
from hwp_bench.capture.schema import CaptureInfo, HandModelId
from hwp_bench.capture.tracks import Cameras
from hwp_bench.capture.writer import CaptureWriter

__all__ = ["Cameras", "Capture", "CaptureInfo", "CaptureWriter", "HandModelId", "open_capture"]
