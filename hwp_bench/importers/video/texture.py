"""Scalar products of many short rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from hwp_bench.base.harmonics import COUNT, harmonics
from hwp_bench.hands import HandTemplate
from hwp_bench.hands.raster import draw_faces, mix_corners


def row_products(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the (P,) scalar products of the rows of (P, C) and (P, C), for small C."""
    # NumPy's sum over a short last axis takes several times as long.
    return np.asarray((first * second) @ np.ones(first.shape[1], first.dtype))


def smooth_within(values: np.ndarray, region: np.ndarray, breadth: float) -> np.ndarray:
    """Gaussian mean over the pixels of a region alone.

    Args:
        values: (H, W) or (H, W, C).
        region: (H, W) bool.
        breadth: deviation of the Gaussian, px.

    Returns:
        float32 of the values' shape, next to the region too; towards zero far from it.
    """
    inside = region.reshape(*region.shape, *(1,) * (values.ndim - 2))
    weight = cv2.GaussianBlur(region.astype(np.float32), (0, 0), breadth)
    total = cv2.GaussianBlur(np.where(inside, values, 0.0).astype(np.float32), (0, 0), breadth)
    return np.asarray(total / np.maximum(weight.reshape(inside.shape), 1e-3))


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
_ODD_DETAIL = 0.06


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
            weights = weights / (1.0 + ((values - self._mean) / _ODD_DETAIL) ** 2)
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


# Edge of the map, texels; twice as many change nothing.
_EDGE = 256
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


@dataclass(frozen=True, eq=False)
class SeenTexels:
    """The texels that a frame shows, T of them.

    Attributes:
        texels: (T,) int32, their numbers.
        logs: (T, 3) logarithms of colours in [0, 1], with `DARK` added before.
        normals: (T, 3) unit, camera axes.
        weights: (T,) in [0, 1].
    """

    texels: np.ndarray
    logs: np.ndarray
    normals: np.ndarray
    weights: np.ndarray


class LitTexture:
    """A colour at each texel, and for each frame a gain that is a function of the normal.

    In logarithms of sRGB both are sums, and each follows from the other by weighted means and
    small least squares. A shadow that the hand casts on itself is in neither.

    Args:
        template: the hand, with its texture coordinates.
        frames: of the clip.
    """

    def __init__(self, template: HandTemplate, frames: int) -> None:
        self.atlas = Atlas(template, _EDGE)
        self._light = np.zeros((frames, COUNT, 3))
        self._colors: np.ndarray | None = None

    def fit(self, seen: Mapping[int, SeenTexels]) -> None:
        """Fit colours and light to frames; what an earlier call found is the start.

        Args:
            seen: by frame, at least one.
        """
        turns = _LATER_TURNS
        if self._colors is None:
            turns = _FIRST_TURNS
            total = sum(float(frame.weights.sum()) for frame in seen.values())
            common = sum(frame.weights @ frame.logs for frame in seen.values()) / max(total, 1e-9)
            self._colors = np.tile(common, (len(self.atlas), 1))
        for _ in range(turns):
            self._turn(seen)
        self._map = self.atlas.drawn(self._colors)
        self._known = self.atlas.drawn_weights(np.minimum(self._count / _ENOUGH, 1.0))

    def expected(
        self, frame: int, face: np.ndarray, mix: np.ndarray, normals: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colours of points of the surface in the light of a frame.

        Args:
            frame: which frame.
            face: (P,) which face each point is on.
            mix: (P, 2) barycentric coordinates as `draw_faces` returns them.
            normals: (P, 3) unit, camera axes.

        Returns:
            (P, 3) sRGB in [0, 1], and (P,) how well the colours are known, in [0, 1].
        """
        places = self.atlas.places(face, mix)
        logs = sample(self._map, places) + harmonics(normals) @ self._light[frame]
        return np.clip(np.exp(logs) - DARK, 0.0, 1.0), sample(self._known, places)

    def _turn(self, seen: Mapping[int, SeenTexels]) -> None:
        """Fit the light of each frame to the colours, and then the colours to all frames."""
        assert self._colors is not None
        count = len(self.atlas)
        total, weight = np.zeros((count, 3)), np.zeros(count)
        for frame, shown in seen.items():
            basis, colors = harmonics(shown.normals), self._colors[shown.texels]
            trust = _trust(shown, shown.logs - colors - basis @ self._light[frame])
            moment = (basis * trust[:, None]).T
            normal = moment @ basis + (_RIDGE * trust.sum() + 1e-9) * np.eye(COUNT)
            self._light[frame] = np.linalg.solve(normal, moment @ (shown.logs - colors))
            unlit = shown.logs - basis @ self._light[frame]
            trust = _trust(shown, unlit - colors)
            weight += np.bincount(shown.texels, trust, minlength=count)
            for channel in range(3):
                part = trust * unlit[:, channel]
                total[:, channel] += np.bincount(shown.texels, part, minlength=count)
        common = total.sum(axis=0) / max(float(weight.sum()), 1e-9)
        self._colors = (total + _COMMON * common) / (weight + _COMMON)[:, None]
        self._count = weight


def _trust(shown: SeenTexels, error: np.ndarray) -> np.ndarray:
    return np.asarray(shown.weights / (1.0 + row_products(error, error) / (3.0 * _ODD**2)))
