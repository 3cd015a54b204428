"""Scoring: which pixels, which formula, which mean. The protocol is in `docs/protocol.md`.

This package loads nothing heavy; import the arithmetic from the module that does it:
`metrics.score` (one frame, many frames), `metrics.aggregate`, `metrics.lpips_weights`.
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
    protocol,
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
    "protocol",
]
