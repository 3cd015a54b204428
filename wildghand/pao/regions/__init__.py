"""The hand y_h and the regions y_u of a frame."""

from wildghand.pao.regions.frame_regions import (
    ClipRegions,
    FrameRegions,
    Regions,
    overlapping,
    partition,
    stack_regions,
)
from wildghand.pao.regions.hand import graph_cut_hands
from wildghand.pao.regions.sam import PromptedHand, SegmentAnything, mask_of, open_sam
from wildghand.pao.regions.superpixels import RegionCache, Segmenter, Superpixels

__all__ = [
    "ClipRegions",
    "FrameRegions",
    "PromptedHand",
    "RegionCache",
    "Regions",
    "SegmentAnything",
    "Segmenter",
    "Superpixels",
    "graph_cut_hands",
    "mask_of",
    "open_sam",
    "overlapping",
    "partition",
    "stack_regions",
]
