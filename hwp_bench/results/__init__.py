"""Results: one JSON file with every frame's scores, and all that is needed to trust them."""

from hwp_bench.results.schema import (
    CaptureResult,
    CurvePoint,
    FrameResult,
    FreeViewResult,
    MethodId,
    Results,
    TrainingData,
)
from hwp_bench.results.store import (
    read_all,
    read_results,
    read_unchanged,
    result_files,
    results_among,
    write_results,
)

__all__ = [
    "CaptureResult",
    "CurvePoint",
    "FrameResult",
    "FreeViewResult",
    "MethodId",
    "Results",
    "TrainingData",
    "read_all",
    "read_results",
    "read_unchanged",
    "result_files",
    "results_among",
    "write_results",
]
