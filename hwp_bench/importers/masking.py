"""The masks of a clip: the user's own, or graph cuts prompted by the fit as it is now."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from hwp_bench.importers.crop import resample
from hwp_bench.importers.outline import signed_distance
from hwp_bench.importers.pictures import Pictures
from hwp_bench.importers.projected import ProjectedClip
from hwp_bench.importers.segment import MaskSettings, Prompt, Segmentation, segment_clip
from hwp_bench.importers.silhouette import overlap


@dataclass(frozen=True, eq=False)
class ClipMasks:
    """Masks of every frame, and how well the mesh agrees with them.

    Attributes:
        coverage: (F, size, size) uint8, visible hand, at the stored resolution.
        fields: (F, FIELD_SIZE, FIELD_SIZE) float16 signed distances of hand and forearm.
        overlap: (F,) intersection over union of the mesh's silhouette and the hand's mask.
    """

    coverage: np.ndarray
    fields: np.ndarray
    overlap: np.ndarray


class Masking:
    """Makes the masks of one clip.

    Args:
        pictures: of the clip.
        detected: (F,) bool, frames whose pose comes from a detection.
        hand_size: px of the working pictures.
        own: (F, S, S) uint8 masks of the user's own at the working resolution, or None.
    """

    def __init__(
        self,
        pictures: Pictures,
        detected: np.ndarray,
        hand_size: float,
        own: np.ndarray | None,
    ) -> None:
        self._pictures = pictures
        self._detected = detected
        self._hand_size = hand_size
        self._own = own

    def masks(
        self,
        projected: ProjectedClip,
        settings: MaskSettings,
        *,
        reduction: int = 1,
        update: Callable[[int], None] | None = None,
    ) -> ClipMasks:
        """Cut the masks, prompted by a fit.

        Args:
            projected: the fit.
            settings: how far to trust it.
            reduction: work at this fraction of the working resolution: 2 is four times faster
                and enough for the outline.
            update: told the number of frames done.
        """
        coverage, fields, overlaps = [], [], []
        size = self._pictures.frames.shape[1]
        for prompt, found in self._segmentations(projected, settings, reduction):
            coverage.append(resample(found.hand, size))
            fields.append(signed_distance(found.skin))
            overlaps.append(overlap(prompt.silhouette > 0, found.hand > 127))
            if update is not None:
                update(len(coverage))
        return ClipMasks(np.stack(coverage), np.stack(fields), np.array(overlaps))

    def _segmentations(
        self, projected: ProjectedClip, settings: MaskSettings, reduction: int
    ) -> Iterator[tuple[Prompt, Segmentation]]:
        working = self._pictures.working
        edge = working.shape[1] // reduction

        def prompt(frame: int) -> Prompt:
            return projected.prompt(frame, edge, bool(self._detected[frame]))

        if self._own is not None:
            for frame, mask in enumerate(self._own):
                own = resample(mask, edge)
                yield prompt(frame), Segmentation(own, own)
            return
        yield from segment_clip(
            lambda frame: resample(working[frame], edge),
            prompt,
            len(working),
            self._hand_size * edge / working.shape[1],
            settings,
        )
