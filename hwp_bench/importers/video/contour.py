"""The term of the fit's energy that pulls the outline of the mesh to the outline of the masks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.hands.raster import draw_silhouette
from hwp_bench.hands.template import boundary_vertices
from hwp_bench.importers.shared.frames_parallel import each_frame
from hwp_bench.importers.shared.windows import CropWindows
from hwp_bench.importers.video.clip_model import ClipModel, PosedClip, posed_vertices
from hwp_bench.importers.video.fit_terms import geman_mcclure
from hwp_bench.importers.video.video_settings import FitSettings

#: Edge of the images in which outlines are compared, px; distances interpolate well, so less
#: than the crop's resolution is enough.
FIELD_SIZE = 192
#: Outline vertices of each frame.
OUTLINE_COUNT = 200
#: Vertices of the outline lie at most this far inside the silhouette, px of the field.
OUTLINE_WITHIN = 1.6
# Step of the search along a normal, px of the field.
_STEP = 0.5


class ContourEnergy:
    """Robust distance of outline vertices from the mask's outline, along their normals.

    The vertices and their targets are chosen by `rematch` between rounds of descent
    and held within a round (iterated closest points). The wrist's open end is not an outline of
    the hand and never chosen.

    Args:
        fields: (F, S, S) signed distances of the masks of hand and forearm, from
            `signed_distance`; zero fields have no effect.
        usable: (F,) bool, frames that count.
        windows: where the fields lie in the whole frame.
        settings: weights and scales.
        hand_size: size of the hand in the whole frame, px.
        ignored: (F, FIELD_SIZE, FIELD_SIZE) bool, where the mask's outline is not this hand's: skin
            meets skin there; None where nothing is.
    """

    def __init__(
        self,
        fields: np.ndarray,
        usable: np.ndarray,
        windows: CropWindows,
        settings: FitSettings,
        hand_size: float,
        ignored: np.ndarray | None = None,
    ) -> None:
        self.fields = fields
        self.ignored = ignored
        self.usable = np.asarray(usable) & (np.abs(fields).max(axis=(1, 2)) > 0)
        self.ratio = FIELD_SIZE / windows.side
        self.corners = torch.as_tensor(windows.corners, dtype=torch.float32)[:, None]
        self.scale = settings.contour_scale * hand_size * self.ratio
        self.reach = settings.contour_reach * hand_size * self.ratio
        self.weight = settings.contour_weight

    def rematch(self, model: ClipModel, update: Callable[[int], None] | None = None) -> None:
        """Choose the outline vertices of the model as it is now, and their targets."""
        faces = model.template.faces
        candidates = np.setdiff1d(np.arange(len(model.template.vertices)), boundary_vertices(faces))
        with torch.no_grad():
            vertices = torch.as_tensor(posed_vertices(model))
            pixels = self._in_field(model.pixels(vertices)).numpy()

        def match(frame: int) -> Outline:
            if not self.usable[frame]:
                return Outline.nothing()
            usable = candidates
            if self.ignored is not None:
                usable = candidates[~_marked(self.ignored[frame], pixels[frame][candidates])]
            return match_outline(pixels[frame], faces, usable, self.fields[frame], self.reach)

        matches = []
        for found in each_frame(match, range(len(self.usable))):
            matches.append(found)
            if update is not None:
                update(len(matches))
        self.normal = torch.as_tensor(np.stack([match.normal for match in matches]))
        self.target = torch.as_tensor(np.stack([match.target for match in matches]))
        self.outline = model.choose(torch.as_tensor(np.stack([match.index for match in matches])))

    def __call__(self, model: ClipModel, posed: PosedClip) -> torch.Tensor:
        """Return the energy, a scalar."""
        pixels = self._in_field(model.pixels(model.vertices(posed, self.outline)))
        # A vertex without a match has a zero normal and a zero target.
        distance = (pixels * self.normal).sum(dim=-1) - self.target
        return self.weight * geman_mcclure((distance / self.scale) ** 2, turn=4.0).sum()

    def _in_field(self, pixels: torch.Tensor) -> torch.Tensor:
        return (pixels - self.corners) * self.ratio


@dataclass(frozen=True, eq=False)
class Outline:
    """Outline vertices of one frame and the line that each is pulled to: normal . pixel = target.

    Attributes:
        index: (OUTLINE_COUNT,) int64 vertices.
        normal: (OUTLINE_COUNT, 2) float32, outward unit normals; zero where nothing matched.
        target: (OUTLINE_COUNT,) float32, px of the field; zero where nothing matched.
    """

    index: np.ndarray
    normal: np.ndarray
    target: np.ndarray

    @classmethod
    def nothing(cls) -> Outline:
        """Return an outline that pulls nothing."""
        return cls(
            np.zeros(OUTLINE_COUNT, dtype=np.int64),
            np.zeros((OUTLINE_COUNT, 2), dtype=np.float32),
            np.zeros(OUTLINE_COUNT, dtype=np.float32),
        )


def signed_distance(mask: np.ndarray) -> np.ndarray:
    """Distance to the outline of a mask, positive outside.

    Args:
        mask: (S, S) uint8, 255 inside.

    Returns:
        (FIELD_SIZE, FIELD_SIZE) float16 in px of the field; zeros where the mask has no outline.
    """
    import cv2

    small = cv2.resize(mask, (FIELD_SIZE, FIELD_SIZE), interpolation=cv2.INTER_AREA)
    inside = (small >= 128).astype(np.uint8)
    if inside.all() or not inside.any():
        return np.zeros((FIELD_SIZE, FIELD_SIZE), dtype=np.float16)
    outer = cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    inner = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Pixel centres next to the outline are half a pixel from it, on either side.
    return (outer - inner - np.where(inside, -0.5, 0.5)).astype(np.float16)


def match_outline(
    pixels: np.ndarray, faces: np.ndarray, candidates: np.ndarray, field: np.ndarray, reach: float
) -> Outline:
    """Match the outline of a mesh with the outline of a mask.

    Each vertex looks along its normal for the nearest place where the mask ends in the same
    direction: a finger's left side never snaps to the right side of its neighbour, as it may
    with the plainly nearest point.

    Args:
        pixels: (V, 2) vertices, px of the field.
        faces: (F, 3) int.
        candidates: (C,) vertices that may be chosen.
        field: (FIELD_SIZE, FIELD_SIZE) signed distance of the mask.
        reach: how far to look, px of the field.
    """
    import cv2

    own = signed_distance(draw_silhouette(pixels, faces, FIELD_SIZE)).astype(np.float32)
    if not own.any():
        return Outline.nothing()
    chosen = _on_outline(pixels, own, candidates)
    places = pixels[chosen].astype(np.float32)
    smooth = cv2.GaussianBlur(own, (0, 0), 1.0)
    gradient = np.stack(
        [_sample(cv2.Sobel(smooth, cv2.CV_32F, *axis), places) for axis in ((1, 0), (0, 1))], axis=1
    )
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    normals = gradient / np.maximum(length, 1e-6)
    steps = np.arange(-reach, reach + _STEP, _STEP, dtype=np.float32)
    along = places[:, None] + normals[:, None] * steps[:, None]
    values = _sample(field.astype(np.float32), along.reshape(-1, 2)).reshape(len(chosen), -1)
    leaves = (values[:, :-1] <= 0) & (values[:, 1:] > 0)
    middle = np.abs(steps[:-1] + 0.5 * _STEP)
    best = np.where(leaves, middle, np.inf).argmin(axis=1)
    rows = np.arange(len(chosen))
    matched = leaves[rows, best] & (length[:, 0] > 1e-6)
    before, after = values[rows, best], values[rows, best + 1]
    crossing = steps[best] + _STEP * before / np.minimum(before - after, -1e-6)
    # A vertex that lies inside the mesh's own outline is to stay as far inside the mask's.
    offset = crossing + _sample(own, places)
    outline = Outline.nothing()
    count = len(chosen)
    outline.index[:count] = chosen
    outline.normal[:count] = np.where(matched[:, None], normals, 0.0)
    outline.target[:count] = np.where(matched, (normals * places).sum(axis=1) + offset, 0.0)
    return outline


def _marked(area: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Whether places (P, 2) px lie in a (S, S) bool area; outside of the image none does."""
    cell = np.floor(places)
    inside = ((cell >= 0) & (cell < len(area))).all(axis=1)
    column, row = np.clip(cell, 0, len(area) - 1).astype(np.int64).T
    return np.asarray(inside & area[row, column])


def _on_outline(pixels: np.ndarray, own: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """Candidates near the outline, at most OUTLINE_COUNT, evenly thinned."""
    cell = np.floor(pixels[candidates])
    inside = ((cell >= 0) & (cell < FIELD_SIZE)).all(axis=1)
    column, row = np.clip(cell, 0, FIELD_SIZE - 1).astype(np.int64).T
    chosen = candidates[inside & (own[row, column] >= -OUTLINE_WITHIN)]
    if len(chosen) > OUTLINE_COUNT:
        chosen = chosen[np.linspace(0, len(chosen) - 1, OUTLINE_COUNT).astype(np.int64)]
    return chosen


def _sample(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Bilinear samples (P,) at (P, 2) px, pixel centres at +0.5, the border repeated."""
    import cv2

    x, y = (places[:, axis, None].astype(np.float32) - 0.5 for axis in (0, 1))
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
