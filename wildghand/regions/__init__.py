"""The hand y_h and the regions y_u of a frame."""

from wildghand.regions.frame_regions import (
    FrameRegions,
    Regions,
    overlapping,
    partition,
    stack_regions,
)

__all__ = ["FrameRegions", "Regions", "overlapping", "partition", "stack_regions"]
