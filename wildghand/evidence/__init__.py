"""Evidence: how much training frames say of each Gaussian, and what holds where they do not."""

from wildghand.evidence.count import shown_frames
from wildghand.evidence.evidence import (
    ColorChanges,
    Evidence,
    EvidenceSettings,
    fill_shares,
    kept_share,
    strengths,
    weigh_evidence,
)

__all__ = [
    "ColorChanges",
    "Evidence",
    "EvidenceSettings",
    "fill_shares",
    "kept_share",
    "shown_frames",
    "strengths",
    "weigh_evidence",
]
