"""The capture on disk: writer, checking reader, check, contact sheet."""

from hwp_bench.capture.folder import Capture, CaptureWriter, identify_hand_model, open_capture
from hwp_bench.capture.schema import Cameras, CaptureInfo, HandModelId

__all__ = [
    "Cameras",
    "Capture",
    "CaptureInfo",
    "CaptureWriter",
    "HandModelId",
    "identify_hand_model",
    "open_capture",
]
