"""Scoring: which pixels, which formula, which mean. The protocol is in `docs/protocol.md`.

This package loads nothing heavy; import the arithmetic from the module that does it:
`metrics.score` (one frame, many frames, their means), `metrics.lpips`.
"""

from __future__ import annotations

from hwp_bench.metrics.protocol import (
    HWP_V1,
    METRICS,
    PAPER_WILDGHAND,
    PROTOCOLS,
    Metric,
    Protocol,
    metric,
    metric_names,
    penalty,
)

__all__ = [
    "HWP_V1",
    "METRICS",
    "PAPER_WILDGHAND",
    "PROTOCOLS",
    "Metric",
    "Protocol",
    "metric",
    "metric_names",
    "penalty",
]
