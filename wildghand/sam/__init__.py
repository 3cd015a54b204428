"""Segment Anything: its network written out, from checkpoints that a person has."""

from wildghand.sam.automatic import AutomaticSettings, automatic_masks
from wildghand.sam.checkpoint import check_checkpoint, checkpoint_digest, load_network
from wildghand.sam.network import SamNetwork, SeenImage

__all__ = [
    "AutomaticSettings",
    "SamNetwork",
    "SeenImage",
    "automatic_masks",
    "check_checkpoint",
    "checkpoint_digest",
    "load_network",
]
