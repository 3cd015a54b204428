"""The mean texture of a hand over a clip, without the light, and each frame's picture of it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hwp_bench.hands import HandTemplate
from hwp_bench.hands.raster import draw_faces, mix_corners
from hwp_bench.importers.video.atlas import Atlas, sample
from hwp_bench.importers.video.within import smooth_within

#: Edge of the atlas, texels.
ATLAS = 384
#: Grey level added before the logarithm: noise of the dark pixels counts less.
_DARK = 8.0
# Pixels next to an outline, or next to an edge in depth, mix two surfaces.
_BORDER = np.ones((5, 5), np.uint8)
_DEPTH_EDGE = 0.012
# m, how much deeper than the nearest surface a texel may lie and still be seen.
_SEEN = 0.004
# Cosine of the angle to the viewer from which a surface counts.
_LEAST_FACING = 0.25
# Frames that a texel must have been seen in, each weighed by its facing squared.
_LEAST_WEIGHT = 5.0
# Log grey: a frame that differs from the mean by more counts less in the next mean.
_ODD = 0.06


@dataclass(frozen=True, eq=False)
class View:
    """A frame as the mesh lies in it; S is the edge of the image.

    Attributes:
        face: (S, S) int32 nearest face, -1 where there is none.
        mix: (S, S, 2) float32 barycentric coordinates.
        depth: (S, S) float32 m.
        region: (S, S) bool, mesh and hand.
        core: (S, S) bool, region away from its border and from edges in depth.
        detail: (S, S) float32 log grey, light and noise removed; zero outside of the region.
        facing: (T,) cosine of each face's angle to the viewer, 0 where it looks away.
    """

    face: np.ndarray
    mix: np.ndarray
    depth: np.ndarray
    region: np.ndarray
    core: np.ndarray
    detail: np.ndarray
    facing: np.ndarray


class SkinTexture:
    """Collects the texture of a clip: the mean of what the frames show at each texel.

    Args:
        template: the hand, with its texture coordinates.
        breadth: px, deviation of the Gaussian whose wider changes count as light.
    """

    def __init__(self, template: HandTemplate, breadth: float) -> None:
        self._faces = template.faces
        self._breadth = breadth
        self._atlas = Atlas(template, ATLAS)
        self._mean: np.ndarray | None = None
        self._sum, self._weight = (np.zeros(len(self._atlas)) for _ in range(2))

    def view(
        self, image: np.ndarray, mask: np.ndarray, vertices: np.ndarray, pixels: np.ndarray
    ) -> View:
        """Look at a frame.

        Args:
            image: (S, S, 3) uint8 RGB.
            mask: (S, S) uint8 coverage of the hand.
            vertices: (V, 3) m, camera axes.
            pixels: (V, 2) px of the image.
        """
        size = image.shape[:2]
        face, mix = draw_faces(pixels, vertices[:, 2], self._faces, (size[0], size[1]))
        inside = face >= 0
        depth = np.zeros(size, np.float32)
        depth[inside] = mix_corners(vertices[:, 2:], self._faces, face[inside], mix[inside])[:, 0]
        region = inside & (mask > 127)
        nearest = cv2.erode(np.where(inside, depth, np.inf).astype(np.float32), _BORDER)
        core = cv2.erode(region.astype(np.uint8), _BORDER) > 0
        core &= cv2.dilate(depth, _BORDER) - nearest <= _DEPTH_EDGE
        grey = np.log(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) + _DARK)
        detail = smooth_within(self.without_light(grey, region), region, 1.0)
        return View(face, mix, depth, region, core, detail, _facing(vertices, self._faces))

    def without_light(self, values: np.ndarray, region: np.ndarray) -> np.ndarray:
        """Subtract what changes over the breadth of light; zero outside of the region."""
        return np.where(region, values - smooth_within(values, region, self._breadth), 0.0).astype(
            np.float32
        )

    def seen(
        self, view: View, vertices: np.ndarray, pixels: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Read a frame at each texel: (K,) log grey, and (K,) weights, zero where it is hidden."""
        places = self._atlas.on_surface(pixels)
        depths = self._atlas.on_surface(vertices[:, 2:])
        facing = view.facing[self._atlas.face]
        here = np.abs(sample(view.depth, places, cv2.INTER_NEAREST) - depths[:, 0]) < _SEEN
        here &= (sample(view.core.astype(np.float32), places, cv2.INTER_NEAREST) > 0) & (
            facing > _LEAST_FACING
        )
        return sample(view.detail, places), np.where(here, facing**2, 0.0)

    def add(self, values: np.ndarray, weights: np.ndarray) -> None:
        """Count a frame's texels; those far from the last mean count less."""
        if self._mean is not None:
            weights = weights / (1.0 + ((values - self._mean) / _ODD) ** 2)
        self._sum += weights * values
        self._weight += weights

    def finish(self) -> None:
        """Form the mean of the frames added, and start again without any."""
        mean = self._sum / (self._weight + 1.0)
        self._mean = mean.astype(np.float32)
        self._drawn = self._atlas.drawn(self._mean)
        self._known = self._atlas.drawn_weights(self._weight)
        self._sum, self._weight = (np.zeros(len(self._atlas)) for _ in range(2))

    def expected(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Draw the mean texture as a frame sees it: (S, S) log grey, and (S, S) bool, is known."""
        inside = view.region
        face = view.face[inside]
        places = self._atlas.places(face, view.mix[inside])
        drawn, known = np.zeros(inside.shape, np.float32), np.zeros(inside.shape, bool)
        drawn[inside] = sample(self._drawn, places)
        known[inside] = (sample(self._known, places) > _LEAST_WEIGHT) & (
            view.facing[face] > _LEAST_FACING
        )
        return drawn, known & view.core


def _facing(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    normal = np.cross(second - first, third - first)
    middle = first + second + third
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(middle, axis=1)
    return np.asarray(np.maximum(-(normal * middle).sum(axis=1) / np.maximum(length, 1e-12), 0.0))
