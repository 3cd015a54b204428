"""The masks of a clip: the user's own, or graph cuts prompted by the fit as it is now."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from hwp_bench.hands.raster import draw_silhouette, overlap
from hwp_bench.hands.template import boundary_vertices
from hwp_bench.importers.shared.windows import CropWindows, resample
from hwp_bench.importers.video.clip_model import ClipModel, posed_vertices
from hwp_bench.importers.video.contour import signed_distance
from hwp_bench.importers.video.decode import ClipImages
from hwp_bench.importers.video.segmentation import MaskSettings, Prompt, Segmentation, segment_clip


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


class Prompts(Protocol):
    """The fit as it is now, of one hand or of two."""

    def prompt(self, frame: int, edge: int, detected: bool) -> Prompt:
        """Draw what prompts the cut of a frame at `edge` px."""
        ...


class Masking:
    """Makes the masks of one clip.

    Args:
        images: of the clip.
        detected: (F,) bool, frames whose pose comes from a detection.
        hand_size: px of the working images.
        own: (F, S, S) uint8 masks of the user's own at the working resolution, or None.
    """

    def __init__(
        self,
        images: ClipImages,
        detected: np.ndarray,
        hand_size: float,
        own: np.ndarray | None,
    ) -> None:
        self._images = images
        self._detected = detected
        self._hand_size = hand_size
        self._own = own

    def masks(
        self,
        projected: Prompts,
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
            update: called with the number of frames done.
        """
        coverage, fields, overlaps = [], [], []
        size = self._images.frames.shape[1]
        for prompt, found in self._segmentations(projected, settings, reduction):
            coverage.append(resample(found.hand, size))
            fields.append(signed_distance(found.skin))
            overlaps.append(overlap(prompt.silhouette > 0, found.hand > 127))
            if update is not None:
                update(len(coverage))
        return ClipMasks(np.stack(coverage), np.stack(fields), np.array(overlaps))

    def _segmentations(
        self, projected: Prompts, settings: MaskSettings, reduction: int
    ) -> Iterator[tuple[Prompt, Segmentation]]:
        working = self._images.working
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


@dataclass(frozen=True, eq=False)
class ProjectedClip:
    """The model projected into every frame.

    Attributes:
        vertices: (F, V, 3) float32 m, camera axes.
        pixels: (F, V, 2) float32, px of the whole frame.
        landmarks: (F, 21, 2) float32, px of the whole frame, the tracker's offsets included.
        depths: (F, 21) float32 m, of the landmarks.
        faces: (T, 3) int64.
        ring: vertices of the open wrist.
        windows: where the crops lie.
    """

    vertices: np.ndarray
    pixels: np.ndarray
    landmarks: np.ndarray
    depths: np.ndarray
    faces: np.ndarray
    ring: np.ndarray
    windows: CropWindows

    def in_crop(self, pixels: np.ndarray, frame: int, edge: int) -> np.ndarray:
        """Move pixels of a whole frame to its crop at `edge` px."""
        return (pixels - self.windows.corners[frame]) * (edge / self.windows.side)

    def prompt(self, frame: int, edge: int, detected: bool) -> Prompt:
        """Draw the mesh in a frame's crop at `edge` px."""
        pixels = self.in_crop(self.pixels[frame], frame, edge)
        return Prompt(
            draw_silhouette(pixels, self.faces, edge),
            beyond_wrist(self.vertices[frame], pixels, self.ring, edge),
            detected,
        )


def project_clip(model: ClipModel, windows: CropWindows) -> ProjectedClip:
    """Pose and project every frame of a fit as it is now."""
    vertices = posed_vertices(model)
    with torch.no_grad():
        pixels = model.pixels(torch.as_tensor(vertices)).numpy()
        points = model.posed().landmarks
        landmarks, depths = model.pixels(points).numpy(), points[..., 2].numpy()
    faces = model.template.faces
    ring = boundary_vertices(faces)
    return ProjectedClip(vertices, pixels, landmarks, depths, faces, ring, windows)


def beyond_wrist(
    vertices: np.ndarray, pixels: np.ndarray, ring: np.ndarray, size: int
) -> np.ndarray:
    """Pixels on the forearm's side of the wrist.

    The open end of the mesh spans a plane; its normal points along the forearm. Seen at the
    wrist's depth, the plane cuts the image in a line, and the forearm lies behind the line.

    Args:
        vertices: (V, 3) camera axes, m.
        pixels: (V, 2) px.
        ring: vertices of the open end.
        size: edge of the image, px.

    Returns:
        (size, size) bool; all False for a mesh without an open end, or seen straight along
        the forearm.
    """
    if len(ring) < 3:
        return np.zeros((size, size), dtype=bool)
    centre = vertices[ring].mean(axis=0)
    normal = np.linalg.svd(vertices[ring] - centre)[2][2]
    if normal @ (vertices.mean(axis=0) - centre) > 0:
        normal = -normal
    middle = pixels[ring].mean(axis=0)
    along = np.arange(size) + 0.5
    depth = (along[None] - middle[0]) * normal[0] + (along[:, None] - middle[1]) * normal[1]
    return depth > 0
