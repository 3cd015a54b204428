"""The pre-pass: judges training frames before the fit, without a network, in about a second."""

from wildghand.prepass.assessment import FrameAssessment, estimated_severity
from wildghand.prepass.inputs import PrepassInput, capture_input
from wildghand.prepass.judge import judge_frames
from wildghand.prepass.settings import PrepassSettings

__all__ = [
    "FrameAssessment",
    "PrepassInput",
    "PrepassSettings",
    "capture_input",
    "estimated_severity",
    "judge_frames",
]
