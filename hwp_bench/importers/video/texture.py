"""The surface of a hand as a clip shows it: its mean texture, and its colours in their light.

Both lie on the texels of the hand's texture map. The texture is what is left of the frames without
the light; the colours come with a light for each frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from hwp_bench.base.colors import COUNT, harmonics
from hwp_bench.hands import HandTemplate
from hwp_bench.hands.raster import draw_faces, mix_corners

# Texels beyond a chart that go on as its border, so that interpolation reads nothing else.
_MARGIN = 1.5
# OpenCV takes at most 32,767 places in a row.
_ROW = 1024


def row_products(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The (P,) scalar products of the rows of (P, C) and (P, C), for small C."""
    # NumPy's sum over a short last axis takes several times as long.
    return np.asarray((first * second) @ np.ones(first.shape[1], first.dtype))


def sample(
    image: np.ndarray,
    places: np.ndarray,
    how: int = cv2.INTER_LINEAR,
    border: int = cv2.BORDER_CONSTANT,
) -> np.ndarray:
    """Read an image (H, W) or (H, W, C) float32 at (P, 2) px, pixel centres at +0.5; C at most 4.

    `how` and `border` are OpenCV's; outside of the image it is zero if nothing else is said.
    """
    padded = np.zeros((-(-max(len(places), 1) // _ROW) * _ROW, 2), np.float32)
    padded[: len(places)] = places - 0.5
    x, y = (np.ascontiguousarray(part.reshape(-1, _ROW)) for part in padded.T)
    found = cv2.remap(image, x, y, how, borderMode=border)
    return np.asarray(found.reshape(-1, *image.shape[2:])[: len(places)])


def smooth_within(values: np.ndarray, region: np.ndarray, breadth: float) -> np.ndarray:
    """Gaussian mean of values (H, W) or (H, W, C) over the pixels of a region (H, W) bool alone.

    `breadth` is the Gaussian's deviation, px. The mean, float32, is also next to the region, and
    falls towards zero far from it.
    """
    inside = region.reshape(*region.shape, *(1,) * (values.ndim - 2))
    weight = cv2.GaussianBlur(region.astype(np.float32), (0, 0), breadth)
    total = cv2.GaussianBlur(np.where(inside, values, 0.0).astype(np.float32), (0, 0), breadth)
    return np.asarray(total / np.maximum(weight.reshape(inside.shape), 1e-3))


class Atlas:
    """The texels of a hand's square texture map of `edge` texels that lie on it, K of them."""

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
        """Where points of faces (P,) with mixes (P, 2) of `draw_faces` lie: (P, 2) texels."""
        return mix_corners(self._corners, self._corner_faces, face, mix)

    def draw(self, values: np.ndarray) -> np.ndarray:
        """Draw values of the texels (K,) or (K, C) as a map, borders of charts drawn on."""
        image = self._scattered(values)
        around = smooth_within(image, self._within, _MARGIN)
        inside = self._within.reshape(*self._within.shape, *(1,) * (values.ndim - 1))
        return np.where(inside, image, around)

    def draw_weights(self, weights: np.ndarray) -> np.ndarray:
        """Draw weights of the texels (K,) as a map; beyond a chart the largest one next to it."""
        image = self._scattered(weights)
        return np.where(self._within, image, cv2.dilate(image, np.ones((3, 3), np.uint8)))

    def _scattered(self, values: np.ndarray) -> np.ndarray:
        """(edge, edge) or (edge, edge, C) float32, zero beyond the charts."""
        image = np.zeros((*self._within.shape, *values.shape[1:]), np.float32)
        image[self._within] = values
        return image


class MeanTexture:
    """The mean of what the frames of a clip show at each texel, log grey without the light."""

    #: Edge of the map, texels.
    EDGE = 384
    # Frames that a texel must have been seen in, each weighed by its facing squared.
    _LEAST_WEIGHT = 5.0
    # Log grey: a frame that differs from the mean by more counts less in the next mean.
    _ODD = 0.06

    def __init__(self, template: HandTemplate) -> None:
        self.atlas = Atlas(template, self.EDGE)
        self._mean: np.ndarray | None = None
        self._sum, self._weight = (np.zeros(len(self.atlas)) for _ in range(2))

    def add(self, values: np.ndarray, weights: np.ndarray) -> None:
        """Count a frame's texels (K,) with weights (K,); those far from the last mean less."""
        if self._mean is not None:
            weights = weights / (1.0 + ((values - self._mean) / self._ODD) ** 2)
        self._sum += weights * values
        self._weight += weights

    def finish(self) -> None:
        """Form the mean of the frames added, and start again without any."""
        mean = self._sum / (self._weight + 1.0)
        self._mean = mean.astype(np.float32)
        self._drawn = self.atlas.draw(self._mean)
        self._known = self.atlas.draw_weights(self._weight)
        self._sum, self._weight = (np.zeros(len(self.atlas)) for _ in range(2))

    def expected(self, face: np.ndarray, mix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The mean at P points of the surface, and whether it is known there."""
        places = self.atlas.places(face, mix)
        return sample(self._drawn, places), sample(self._known, places) > self._LEAST_WEIGHT


@dataclass(frozen=True, eq=False)
class SeenTexels:
    """The texels that a frame shows, T of them."""

    #: (T,) int32, their numbers.
    texels: np.ndarray
    #: (T, 3) logarithms of colours in [0, 1], with `LitTexture.DARK` added before.
    logs: np.ndarray
    #: (T, 3) unit, camera axes.
    normals: np.ndarray
    #: (T,) in [0, 1].
    weights: np.ndarray


class LitTexture:
    """A colour at each texel, and for each frame a gain that is a function of the normal.

    In logarithms of sRGB both are sums, and each follows from the other by weighted means and
    small least squares. A shadow that the hand casts on itself is in neither.
    """

    #: Edge of the map, texels; twice as many change nothing.
    EDGE = 256
    #: Added to colours before the logarithm: noise of dark pixels counts less.
    DARK = 0.04
    # Logarithm of a colour: a frame that differs by more counts less.
    _ODD = 0.1
    # Weight of no light of its own, as a share of the frame's texels.
    _RIDGE = 0.02
    # Weight of the mean colour at each texel, in frames that show it from the front.
    _COMMON = 0.5
    # Frames from the front that a texel must have been seen in to count fully.
    _ENOUGH = 2.0
    # Turns of light and colours, at first and each time after that.
    _FIRST_TURNS, _LATER_TURNS = 4, 2

    def __init__(self, template: HandTemplate, frames: int) -> None:
        self.atlas = Atlas(template, self.EDGE)
        self._light = np.zeros((frames, COUNT, 3))
        self._colors: np.ndarray | None = None

    def fit(self, seen: Mapping[int, SeenTexels]) -> None:
        """Fit colours and light to one frame or more; what an earlier call found is the start."""
        turns = self._LATER_TURNS
        if self._colors is None:
            turns = self._FIRST_TURNS
            total = sum(float(frame.weights.sum()) for frame in seen.values())
            common = sum(frame.weights @ frame.logs for frame in seen.values()) / max(total, 1e-9)
            self._colors = np.tile(common, (len(self.atlas), 1))
        for _ in range(turns):
            self._turn(seen)
        self._map = self.atlas.draw(self._colors)
        self._known = self.atlas.draw_weights(np.minimum(self._count / self._ENOUGH, 1.0))

    def expected(
        self, frame: int, face: np.ndarray, mix: np.ndarray, normals: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colours of P points of the surface in the light of a frame, and how well they are known.

        With unit normals (P, 3), camera axes: (P, 3) sRGB in [0, 1], and (P,) in [0, 1].
        """
        places = self.atlas.places(face, mix)
        logs = sample(self._map, places) + harmonics(normals) @ self._light[frame]
        return np.clip(np.exp(logs) - self.DARK, 0.0, 1.0), sample(self._known, places)

    def _turn(self, seen: Mapping[int, SeenTexels]) -> None:
        """Fit the light of each frame to the colours, and then the colours to all frames."""
        assert self._colors is not None
        count = len(self.atlas)
        total, weight = np.zeros((count, 3)), np.zeros(count)
        for frame, shown in seen.items():
            basis, colors = harmonics(shown.normals), self._colors[shown.texels]
            trust = self._trust(shown, shown.logs - colors - basis @ self._light[frame])
            moment = (basis * trust[:, None]).T
            normal = moment @ basis + (self._RIDGE * trust.sum() + 1e-9) * np.eye(COUNT)
            self._light[frame] = np.linalg.solve(normal, moment @ (shown.logs - colors))
            unlit = shown.logs - basis @ self._light[frame]
            trust = self._trust(shown, unlit - colors)
            weight += np.bincount(shown.texels, trust, minlength=count)
            for channel in range(3):
                part = trust * unlit[:, channel]
                total[:, channel] += np.bincount(shown.texels, part, minlength=count)
        common = total.sum(axis=0) / max(float(weight.sum()), 1e-9)
        self._colors = (total + self._COMMON * common) / (weight + self._COMMON)[:, None]
        self._count = weight

    def _trust(self, shown: SeenTexels, error: np.ndarray) -> np.ndarray:
        return np.asarray(shown.weights / (1.0 + row_products(error, error) / (3.0 * self._ODD**2)))
