"""Evidence: how much training frames say of each Gaussian, and what holds where they do not."""

from wildghand.evidence.count import shown_frames
from wildghand.evidence.evidence import Evidence, strengths, weigh_evidence
from wildghand.evidence.other_hand import OtherHand
from wildghand.evidence.settings import EvidenceSettings

__all__ = [
    "Evidence",
    "EvidenceSettings",
    "OtherHand",
    "shown_frames",
    "strengths",
    "weigh_evidence",
]
