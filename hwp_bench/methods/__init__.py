"""The method contract, method directories, requests, and settings."""

from hwp_bench.methods.contract import (
    Avatar,
    Budget,
    Camera,
    HandPose,
    Method,
    Report,
    TrainingCapture,
)
from hwp_bench.methods.manifest import MethodManifest, find_method, read_manifest
from hwp_bench.methods.request import open_request

__all__ = [
    "Avatar",
    "Budget",
    "Camera",
    "HandPose",
    "Method",
    "MethodManifest",
    "Report",
    "TrainingCapture",
    "find_method",
    "open_request",
    "read_manifest",
]
