"""The capture on disk: writer, checking reader, check, contact sheet."""

from hwp_bench.capture.reader import Capture, identify_hand_model, open_capture
from hwp_bench.capture.schema import Cameras, CaptureInfo, HandModelId
from hwp_bench.capture.writer import CaptureWriter

__all__ = [
    "Cameras",
    "Capture",
    "CaptureInfo",
    "CaptureWriter",
    "HandModelId",
    "identify_hand_model",
    "open_capture",
]
