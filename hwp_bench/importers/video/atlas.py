"""The texture map of a hand: where its texels lie on the surface, and how a map is read."""

from __future__ import annotations

import cv2
import numpy as np

from hwp_bench.hands import HandTemplate
from hwp_bench.hands.raster import draw_faces, mix_corners
from hwp_bench.importers.video.within import smooth_within

# Texels beyond a chart that go on as its border, so that interpolation reads nothing else.
_MARGIN = 1.5
# OpenCV takes at most 32,767 places in a row.
_ROW = 1024


class Atlas:
    """The texels of a hand's texture map that lie on its surface, K of them.

    Args:
        template: the hand, with its texture coordinates.
        edge: of the square map, texels.
    """

    def __init__(self, template: HandTemplate, edge: int) -> None:
        self._faces = template.faces
        # Corners of faces have their own places in the map; its seams need no care then.
        self._corners = (template.uv[template.face_uv].reshape(-1, 2) * edge).astype(np.float32)
        self._corner_faces = np.arange(len(self._corners)).reshape(-1, 3)
        face, mix = draw_faces(
            self._corners, np.ones(len(self._corners)), self._corner_faces, (edge, edge)
        )
        self._within = face >= 0
        #: (K,) int32 face of each texel.
        self.face = face[self._within]
        self._mix = mix[self._within]

    def __len__(self) -> int:
        return len(self.face)

    def on_surface(self, values: np.ndarray) -> np.ndarray:
        """Interpolate values of the vertices (V, C) at each texel: (K, C) float32."""
        return mix_corners(values, self._faces, self.face, self._mix)

    def places(self, face: np.ndarray, mix: np.ndarray) -> np.ndarray:
        """Return where points of the surface lie in the map: (P, 2) texels.

        Args:
            face: (P,) which face each point is on.
            mix: (P, 2) barycentric coordinates as `draw_faces` returns them.
        """
        return mix_corners(self._corners, self._corner_faces, face, mix)

    def drawn(self, values: np.ndarray) -> np.ndarray:
        """Draw values of the texels (K,) or (K, C) as a map, borders of charts drawn on."""
        image = self._scattered(values)
        around = smooth_within(image, self._within, _MARGIN)
        inside = self._within.reshape(*self._within.shape, *(1,) * (values.ndim - 1))
        return np.where(inside, image, around)

    def drawn_weights(self, weights: np.ndarray) -> np.ndarray:
        """Draw weights of the texels (K,) as a map; beyond a chart the largest one next to it."""
        image = self._scattered(weights)
        return np.where(self._within, image, cv2.dilate(image, np.ones((3, 3), np.uint8)))

    def _scattered(self, values: np.ndarray) -> np.ndarray:
        """(edge, edge) or (edge, edge, C) float32, zero beyond the charts."""
        image = np.zeros((*self._within.shape, *values.shape[1:]), np.float32)
        image[self._within] = values
        return image


def sample(image: np.ndarray, places: np.ndarray, how: int = cv2.INTER_LINEAR) -> np.ndarray:
    """Read an image at places.

    Args:
        image: (H, W) or (H, W, C) float32, C at most 4.
        places: (P, 2) px, pixel centres at +0.5.
        how: OpenCV's name of an interpolation.

    Returns:
        (P,) or (P, C); zero outside of the image.
    """
    padded = np.zeros((-(-max(len(places), 1) // _ROW) * _ROW, 2), np.float32)
    padded[: len(places)] = places - 0.5
    x, y = (np.ascontiguousarray(part.reshape(-1, _ROW)) for part in padded.T)
    found = cv2.remap(image, x, y, how)
    return np.asarray(found.reshape(-1, *image.shape[2:])[: len(places)])
