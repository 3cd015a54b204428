"""The pre-pass: judges training frames before the fit, without a network, in about a second."""

from wildghand.prepass.assessment import (
    FrameAssessment,
    PrepassSettings,
    estimated_severity,
    frames_text,
)
from wildghand.prepass.judge import judge_frames
from wildghand.prepass.measurements import PrepassInput, capture_input

__all__ = [
    "FrameAssessment",
    "PrepassInput",
    "PrepassSettings",
    "capture_input",
    "estimated_severity",
    "frames_text",
    "judge_frames",
]
