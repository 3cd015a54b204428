"""The surface of a hand as a clip shows it, and the residuals of whole frames.

The surface has a mean texture and, in each frame's light, colours. Both lie on the texels of the
hand's texture map. The texture is what is left of the frames without the light; the colours come
with a light for each frame. Frames are compared with either.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch

from hwp_bench.base.arrays import surrounding
from hwp_bench.base.colors import COUNT, harmonics
from hwp_bench.base.images import sample
from hwp_bench.base.kernels import compiled
from hwp_bench.hands import HandTemplate
from hwp_bench.hands.raster import draw_faces, mix_corners
from hwp_bench.importers.shared.frames import CropWindows, each_frame
from hwp_bench.importers.video.model import (
    FRAME_VARIABLES,
    ClipModel,
    SurfaceMotion,
    join_frames,
    pose_vertices,
    split_frames,
)

# Texels beyond a chart that continue as its border, so that interpolation reads nothing else.
_MARGIN = 1.5
# Px, deviation of a Gaussian that is still well taken from pixels.
_FINE = 2.5


def row_products(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The (P,) scalar products of the rows of (P, C) and (P, C), for small C."""
    # NumPy's sum over a short last axis takes several times as long.
    return np.asarray((first * second) @ np.ones(first.shape[1], first.dtype))


def smooth_within(values: np.ndarray, region: np.ndarray, breadth: float) -> np.ndarray:
    """Gaussian mean of values (H, W) or (H, W, C) over the pixels of a region (H, W) bool alone.

    `breadth` is the Gaussian's deviation, px. The mean, float32, is also next to the region, and
    falls towards zero far from it.
    """
    inside = region.reshape(*region.shape, *(1,) * (values.ndim - 2))
    weight = _smooth(region.astype(np.float32), breadth)
    total = _smooth(np.where(inside, values, 0.0).astype(np.float32), breadth)
    return np.asarray(total / np.maximum(weight.reshape(inside.shape), 1e-3))


def _smooth(image: np.ndarray, breadth: float) -> np.ndarray:
    """Gaussian mean of an image; a broad one in a reduced image, which costs a fraction."""
    size = image.shape[1::-1]
    step = max(int(breadth / _FINE), 1)
    if step > 1:
        reduced = tuple(-(-edge // step) for edge in size)
        image = cv2.resize(image, reduced, interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), breadth / step)
    return image if step == 1 else cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)


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

    #: Edge of the map, texels.
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
        known = self.atlas.draw_weights(np.minimum(self._count / self._ENOUGH, 1.0))
        self._map = np.dstack([self.atlas.draw(self._colors), known])

    def shade(self, frame: int, normals: np.ndarray) -> np.ndarray:
        """Logarithms of the light of a frame on unit normals (P, 3), camera axes: (P, 3)."""
        return np.asarray(harmonics(normals) @ self._light[frame])

    def expected(
        self, face: np.ndarray, mix: np.ndarray, shade: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colours of P points of the surface in light of `shade`, and how well they are known.

        These are (P, 3) sRGB in [0, 1], and (P,) in [0, 1].
        """
        found = sample(self._map, self.atlas.places(face, mix))
        return np.clip(np.exp(found[:, :3] + shade) - self.DARK, 0.0, 1.0), found[:, 3]

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


# --- The residuals

#: Pixels of a frame below which it says nothing.
_LEAST_PIXELS = 50
# m, how much deeper than the nearest surface a texel may lie and still be seen.
_SEEN = 0.004
# Cosine of the angle to the viewer from which a surface counts.
_LEAST_FACING = 0.25
# Pixels around what is compared that smoothing and slopes read.
_MARGINS = 5
# Rows in a product of matrices.
_BLOCK = 24


@dataclass(frozen=True, eq=False)
class HandPictures:
    """The frames of a clip as the fit of one hand sees them; S is the edge of the images."""

    #: (F, S, S, 3) uint8 RGB.
    images: np.ndarray
    #: (F, S, S) uint8 coverage of the hand.
    masks: np.ndarray
    #: (F,) bool, frames that count.
    usable: np.ndarray
    #: Where the images lie in the whole frame.
    windows: CropWindows
    #: Size of the hand in the whole frame, px.
    hand_size: float
    #: (F, S, S) uint8 coverage of another hand, or None.
    other: np.ndarray | None = None

    @property
    def ratio(self) -> float:
        """Px of the images to one px of the whole frame."""
        return float(self.images.shape[1] / self.windows.side)

    @property
    def frames(self) -> list[int]:
        """The frames that count."""
        return [int(frame) for frame in np.flatnonzero(self.usable)]

    def place(self, model: ClipModel) -> tuple[np.ndarray, np.ndarray]:
        """Place a model in the images: its vertices (F, V, 3) m, and (F, V, 2) px of them."""
        vertices = pose_vertices(model)
        with torch.no_grad():
            pixels = model.pixels(torch.as_tensor(vertices)).numpy()
        return vertices, self.windows.place(pixels, self.images.shape[1]).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Drawn:
    """The mesh of one frame: vertices (V, 3) m, their (V, 2) px, and what each pixel shows."""

    vertices: np.ndarray
    pixels: np.ndarray
    faces: np.ndarray
    #: (S, S) int32 nearest face, -1 where there is none.
    face: np.ndarray
    #: (S, S, 2) float32 barycentric coordinates.
    mix: np.ndarray

    @property
    def inside(self) -> np.ndarray:
        """(S, S) bool, where the mesh is."""
        return np.asarray(self.face >= 0)

    def mixed(self, values: np.ndarray) -> np.ndarray:
        """Values of the vertices (V, C) at the pixels inside."""
        inside = self.inside
        return mix_corners(values, self.faces, self.face[inside], self.mix[inside])

    def depth(self, outside: float) -> np.ndarray:
        """(S, S) float32 m."""
        depth = np.full(self.face.shape, outside, np.float32)
        depth[self.inside] = self.mixed(self.vertices[:, 2:])[:, 0]
        return depth


@dataclass(frozen=True, eq=False)
class Differences:
    """A frame compared with what is expected of it, at P pixels; C channels."""

    #: (P,) the face that each pixel shows, or that is nearest to it.
    face: np.ndarray
    #: (P, 2) barycentric coordinates as `draw_faces` returns them.
    mix: np.ndarray
    #: (P, C) the frame less what is expected.
    error: np.ndarray
    #: (P, C) how the picture changes to the right and downwards, by px of the images.
    across: np.ndarray
    down: np.ndarray
    #: (P,) weights.
    trust: np.ndarray


class SurfaceResidual(ABC):
    """Difference of every frame from what its hand's surface should look like, in second order.

    `rematch` collects the surface with the model as it is and linearises the difference of each
    pixel. Within a round of descent the energy is then a quadratic function of the variables of
    each frame, zero where it was linearised, which costs next to nothing. `weight` is of the energy
    of as many pixels as the hand's size squared.
    """

    def __init__(self, pictures: HandPictures, model: ClipModel, weight: float) -> None:
        self.pictures = pictures
        self._faces = model.template.faces
        #: Px of the images.
        self._size = pictures.hand_size * pictures.ratio
        # The energy of a whole hand is the same in images of any size.
        self._weight = weight / self._size**2

    @abstractmethod
    def seen(self, frame: int, drawn: Drawn) -> Any:
        """The surface as a frame shows it."""

    @abstractmethod
    def collect(self, frames: list[int], seen: Iterable[Any]) -> None:
        """Join what the frames show."""

    @abstractmethod
    def differences(self, frame: int, drawn: Drawn) -> Differences | None:
        """Compare a frame with the collected texture; None if it shows too little."""

    def draw(self, vertices: np.ndarray, pixels: np.ndarray) -> Drawn:
        """Draw the mesh of a frame in its image."""
        size = self.pictures.images.shape[1:3]
        face, mix = draw_faces(pixels, vertices[:, 2], self._faces, (size[0], size[1]))
        return Drawn(vertices, pixels, self._faces, face, mix)

    def rematch(self, model: ClipModel) -> None:
        """Collect the surface and linearise the differences, with the model as it is now."""
        usable = self.pictures.frames
        vertices, pixels = self.pictures.place(model)
        motion = SurfaceMotion(model)

        # Each frame is drawn twice: all drawings together would need 1 MB for each frame.
        def seen(frame: int) -> Any:
            return self.seen(frame, self.draw(vertices[frame], pixels[frame]))

        def linear(frame: int) -> tuple[np.ndarray, np.ndarray] | None:
            found = self.differences(frame, self.draw(vertices[frame], pixels[frame]))
            if found is None:
                return None
            return linearize(motion, frame, self._faces, found, self.pictures.ratio)

        self.collect(usable, each_frame(seen, usable))
        self._start = join_frames(model.variables.read())
        curvature = np.zeros((len(self._start), FRAME_VARIABLES, FRAME_VARIABLES))
        slope = np.zeros((len(self._start), FRAME_VARIABLES))
        for frame, found in zip(usable, each_frame(linear, usable), strict=True):
            if found is not None:
                curvature[frame], slope[frame] = found
        self._curvature, self._slope = curvature, slope

    def add(self, free: dict[str, np.ndarray], slopes: dict[str, np.ndarray]) -> float:
        """Add the derivatives by the variables; return the energy, zero where it was linearised."""
        step = join_frames(free) - self._start
        bent = (self._curvature @ step[..., None])[..., 0]
        for name, part in split_frames(self._weight * (bent + self._slope)).items():
            slopes[name] += part
        return self._weight * float((step * (0.5 * bent + self._slope)).sum())


def linearize(
    motion: SurfaceMotion, frame: int, faces: np.ndarray, found: Differences, ratio: float
) -> tuple[np.ndarray, np.ndarray]:
    """Differentiate half the weighed squared differences by the variables of their frame.

    A surface that moves by u takes its picture with it, so that a pixel gets less of what is
    ahead of it: the difference grows by the picture's slope times u. `ratio` is px of the images to
    one px of the whole frame. Returns curvature (51, 51) and slope (51,).
    """
    corners = np.zeros((int(faces.max()) + 1, 5))
    _collect(
        faces, found.face, found.mix, found.error, found.across, found.down, found.trust, corners
    )
    used = np.flatnonzero(corners[:, 0] + corners[:, 2] > 0)
    rates = motion.by_variables(frame, used) * ratio
    xx, xy, yy, *pull = corners[used].T
    x, y = rates[:, 0], rates[:, 1]
    weighed = np.stack(
        [xx[:, None] * x + xy[:, None] * y, xy[:, None] * x + yy[:, None] * y], axis=1
    )
    slope = np.einsum("pk,p->k", x, pull[0]) + np.einsum("pk,p->k", y, pull[1])
    return _summed(rates, weighed), slope


@compiled(nogil=True)
def _collect(
    faces: np.ndarray,
    face: np.ndarray,
    mix: np.ndarray,
    error: np.ndarray,
    across: np.ndarray,
    down: np.ndarray,
    trust: np.ndarray,
    corners: np.ndarray,
) -> None:
    """Sum the weighed products of slopes with each other and with the error at the corners."""
    for p in range(len(face)):
        xx = xy = yy = x = y = 0.0
        for channel in range(error.shape[1]):
            right, below = across[p, channel], down[p, channel]
            xx += right * right
            xy += right * below
            yy += below * below
            x += right * error[p, channel]
            y += below * error[p, channel]
        for corner in range(3):
            share = 1.0 - mix[p, 0] - mix[p, 1] if corner == 0 else 1.0 * mix[p, corner - 1]
            share *= trust[p]
            row = corners[faces[face[p], corner]]
            row[0] += share * xx
            row[1] += share * xy
            row[2] += share * yy
            row[3] += share * x
            row[4] += share * y


def _summed(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Sum over P and 2 of the products of (P, 2, K) and (P, 2, K): (K, K).

    In blocks that are too small for BLAS to start threads of its own next to those that frames
    are worked on in; so the result does not depend on their number either.
    """
    rows = np.zeros((2, -(-2 * len(first) // _BLOCK) * _BLOCK, first.shape[2]))
    for row, part in zip(rows, (first, second), strict=True):
        row[: 2 * len(part)] = part.reshape(-1, part.shape[2])
    left, right = rows.reshape(2, -1, _BLOCK, first.shape[2])
    return np.asarray((left.transpose(0, 2, 1) @ right).sum(axis=0))


@dataclass(frozen=True, eq=False)
class PictureView:
    """A frame without its light, as the mesh lies in it."""

    #: (S, S) bool, mesh and hand.
    region: np.ndarray
    #: (S, S) bool, region away from its border and from edges in depth.
    core: np.ndarray
    #: (S, S) float32 log grey, light and noise removed; zero outside of the region.
    detail: np.ndarray
    #: (S, S) float32 m; zero where no mesh is.
    depth: np.ndarray
    #: (T,) cosine of each face's angle to the viewer, 0 where it looks away.
    facing: np.ndarray


class TextureResidual(SurfaceResidual):
    """Difference of each frame from the mean texture of all frames.

    An outline does not show how a finger is turned about its axis, or a palm about an axis in the
    image; wrinkles, nails and veins can.
    """

    #: Weight, and difference of a pixel that is still normal, log grey.
    WEIGHT, SCALE = 770.0, 0.06
    #: Edge of the texture's map, texels; fewer cost 3 % of the hand's shape.
    EDGE = 384
    # Frames that a texel must have been seen in, each weighed by its facing squared.
    _LEAST_WEIGHT = 5.0
    # Log grey: a frame that differs from the mean by more counts less in the next mean.
    _ODD = 0.06
    # Changes wider than this share of the hand's size count as light, not as texture.
    _LIGHT_BREADTH = 0.05
    # Grey level added before the logarithm: noise of the dark pixels counts less.
    _DARK = 8.0
    # Pixels next to an outline, or next to an edge in depth, m, mix two surfaces.
    _BORDER = np.ones((5, 5), np.uint8)
    _DEPTH_EDGE = 0.012

    def __init__(self, pictures: HandPictures, model: ClipModel) -> None:
        super().__init__(pictures, model, self.WEIGHT)
        self.atlas = Atlas(model.template, self.EDGE)
        self._mean: np.ndarray | None = None

    def view(self, frame: int, drawn: Drawn) -> PictureView:
        """Take the light off a frame."""
        inside, depth = drawn.inside, drawn.depth(0.0)
        region = inside & (self.pictures.masks[frame] > 127)
        nearest = cv2.erode(np.where(inside, depth, np.inf).astype(np.float32), self._BORDER)
        core = cv2.erode(region.astype(np.uint8), self._BORDER) > 0
        core &= cv2.dilate(depth, self._BORDER) - nearest <= self._DEPTH_EDGE
        grey = cv2.cvtColor(self.pictures.images[frame], cv2.COLOR_RGB2GRAY)
        logs = np.log(grey.astype(np.float32) + self._DARK)
        detail = smooth_within(self._without_light(logs, region), region, 1.0)
        return PictureView(region, core, detail, depth, _facing(drawn.vertices, drawn.faces))

    def seen(self, frame: int, drawn: Drawn) -> tuple[np.ndarray, np.ndarray]:
        """Read a frame at each texel: (K,) log grey, and (K,) weights, zero where it is hidden."""
        view, atlas = self.view(frame, drawn), self.atlas
        places = atlas.on_surface(drawn.pixels)
        depths = atlas.on_surface(drawn.vertices[:, 2:])
        facing = view.facing[atlas.face]
        here = np.abs(sample(view.depth, places, cv2.INTER_NEAREST) - depths[:, 0]) < _SEEN
        here &= (sample(view.core.astype(np.float32), places, cv2.INTER_NEAREST) > 0) & (
            facing > _LEAST_FACING
        )
        return sample(view.detail, places), np.where(here, facing**2, 0.0)

    def collect(self, frames: list[int], seen: Iterable[tuple[np.ndarray, np.ndarray]]) -> None:
        """Form the mean at each texel; what is far from the mean before counts less."""
        total, weight = (np.zeros(len(self.atlas)) for _ in range(2))
        for values, weights in seen:
            if self._mean is not None:
                weights = weights / (1.0 + ((values - self._mean) / self._ODD) ** 2)
            total += weights * values
            weight += weights
        self._mean = (total / (weight + 1.0)).astype(np.float32)
        self._drawn, self._known = self.atlas.draw(self._mean), self.atlas.draw_weights(weight)

    def expected(self, view: PictureView, drawn: Drawn) -> tuple[np.ndarray, np.ndarray]:
        """Draw the mean texture in a frame: (S, S) log grey, and (S, S) bool, whether it counts."""
        inside = view.region
        face = drawn.face[inside]
        places = self.atlas.places(face, drawn.mix[inside])
        mean, known = np.zeros(inside.shape, np.float32), np.zeros(inside.shape, bool)
        mean[inside] = sample(self._drawn, places)
        known[inside] = sample(self._known, places) > self._LEAST_WEIGHT
        known[inside] &= view.facing[face] > _LEAST_FACING
        return mean, known & view.core

    def differences(self, frame: int, drawn: Drawn) -> Differences | None:
        """Compare a frame with the mean texture, light taken off both."""
        view = self.view(frame, drawn)
        expected, core = self.expected(view, drawn)
        if np.count_nonzero(core) < _LEAST_PIXELS:
            return None
        error = self._without_light(view.detail - expected, core)[core]
        # The mean of both images' gradients makes the step of second order.
        # Benhimane and Malis, "Homography-based 2D visual tracking and servoing", 2007.
        both = view.detail + expected
        across, down = (
            cv2.Scharr(both, cv2.CV_32F, *axis)[core] / 64.0 for axis in ((1, 0), (0, 1))
        )
        trust = 1.0 / (1.0 + (error / (2.0 * self.SCALE)) ** 2) ** 2 / self.SCALE**2
        columns = (error[:, None], across[:, None], down[:, None])
        return Differences(drawn.face[core], drawn.mix[core], *columns, trust)

    def _without_light(self, values: np.ndarray, region: np.ndarray) -> np.ndarray:
        """Subtract slow changes, which are those of light; zero outside of the region."""
        light = smooth_within(values, region, self._LIGHT_BREADTH * self._size)
        return np.where(region, values - light, 0.0).astype(np.float32)


class PictureResidual(SurfaceResidual):
    """Difference of each frame from the hand drawn in its colours and light.

    Unlike the texture it compares whole pictures: with what is as broad as light, the borders of
    fingers before a palm, and the hand's own border, beyond which both are black. Around another
    hand nothing is compared.
    """

    #: Weight, and difference of a pixel that is still normal, sRGB in [0, 1].
    WEIGHT, SCALE = 1000.0, 0.06
    # Pixels next to a border mix two surfaces.
    _BORDER = np.ones((3, 3), np.uint8)
    # Both pictures are compared this far off hand and mask: their borders say where a hand ends.
    _REACH = np.ones((5, 5), np.uint8)
    # px, deviation of the Gaussian that both are smoothed by: a drawn border is a step.
    _SMOOTH = 1.0

    def __init__(self, pictures: HandPictures, model: ClipModel) -> None:
        super().__init__(pictures, model, self.WEIGHT)
        self.texture = LitTexture(model.template, len(pictures.images))

    def seen(self, frame: int, drawn: Drawn) -> SeenTexels:
        """The texels that a frame shows from the front, away from borders."""
        depth = drawn.depth(np.inf)
        hand = drawn.inside & (self.pictures.masks[frame] > 127)
        core = cv2.erode(hand.astype(np.float32), self._BORDER)
        atlas = self.texture.atlas
        places, points = atlas.on_surface(drawn.pixels), atlas.on_surface(drawn.vertices)
        normals = _unit(atlas.on_surface(_normals(drawn)))
        facing = -row_products(normals, _unit(points))
        nearest = sample(cv2.erode(depth, self._BORDER), places, cv2.INTER_NEAREST)
        here = (facing > _LEAST_FACING) & (np.abs(nearest - points[:, 2]) < _SEEN)
        shown = np.flatnonzero(here & (sample(core, places, cv2.INTER_NEAREST) > 0))
        logs = np.log(self.pictures.images[frame].astype(np.float32) / 255.0 + LitTexture.DARK)
        return SeenTexels(
            texels=shown.astype(np.int32),
            logs=sample(logs, places[shown]),
            normals=normals[shown],
            weights=facing[shown] ** 2,
        )

    def collect(self, frames: list[int], seen: Iterable[SeenTexels]) -> None:
        """Fit colours and light."""
        if frames:
            self.texture.fit(dict(zip(frames, seen, strict=True)))

    def differences(self, frame: int, drawn: Drawn) -> Differences | None:
        """Compare a frame with the lit hand, both before black."""
        inside, mask = drawn.inside, self.pictures.masks[frame]
        if np.count_nonzero(inside) < _LEAST_PIXELS or not mask.any():
            return None
        # Light changes slowly over the surface, so that it is mixed like all that vertices have.
        shade = drawn.mixed(self.texture.shade(frame, _normals(drawn)))
        # Only what is around hand and mask is looked at.
        near = cv2.dilate((inside | (mask > 127)).astype(np.uint8), self._REACH) > 0
        around = surrounding(near, _MARGINS)
        inside, mask, near = inside[around], mask[around], near[around]
        face, mix = drawn.face[around], drawn.mix[around]
        expected = np.zeros((*inside.shape, 3), np.float32)
        known = np.zeros(inside.shape, np.float32)
        expected[inside], known[inside] = self.texture.expected(face[inside], mix[inside], shade)
        coverage = mask.astype(np.float32) / 255.0**2
        image = self.pictures.images[frame][around] * coverage[..., None]
        expected, image = (cv2.GaussianBlur(one, (0, 0), self._SMOOTH) for one in (expected, image))
        if self.pictures.other is not None:
            near &= cv2.dilate(self.pictures.other[frame][around], self._REACH) == 0
        chosen = np.flatnonzero(near)
        # The mean of both pictures' slopes, as for the texture.
        both = 0.5 * (image + expected)
        slopes = (cv2.Scharr(both, cv2.CV_32F, *axis) / 32.0 for axis in ((1, 0), (0, 1)))
        error, across, down = (one.reshape(-1, 3)[chosen] for one in (image - expected, *slopes))
        squared = row_products(error, error) / (3.0 * (2.0 * self.SCALE) ** 2)
        # Pixels off the hand move as the nearest pixel on it: its border moves with it.
        nearest = _nearest(inside).ravel()[chosen]
        trust = known.ravel()[nearest] / (1.0 + squared) ** 2 / self.SCALE**2
        place = (face.ravel()[nearest], mix.reshape(-1, 2)[nearest])
        return Differences(*place, error, across, down, trust)


def _facing(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    normal = np.cross(second - first, third - first)
    middle = first + second + third
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(middle, axis=1)
    return np.asarray(np.maximum(-(normal * middle).sum(axis=1) / np.maximum(length, 1e-12), 0.0))


def _normals(drawn: Drawn) -> np.ndarray:
    """(V, 3) unit, of the vertices: those of their faces, weighed by area."""
    sums = np.zeros(drawn.vertices.shape)
    _sum_normals(drawn.vertices, drawn.faces, sums)
    return _unit(sums)


@compiled(nogil=True)
def _sum_normals(vertices: np.ndarray, faces: np.ndarray, sums: np.ndarray) -> None:
    for t in range(len(faces)):
        a, b, c = faces[t]
        x, y, z = vertices[a]
        right = vertices[b, 0] - x, vertices[b, 1] - y, vertices[b, 2] - z
        left = vertices[c, 0] - x, vertices[c, 1] - y, vertices[c, 2] - z
        for corner in (a, b, c):
            sums[corner, 0] += right[1] * left[2] - right[2] * left[1]
            sums[corner, 1] += right[2] * left[0] - right[0] * left[2]
            sums[corner, 2] += right[0] * left[1] - right[1] * left[0]


def _nearest(inside: np.ndarray) -> np.ndarray:
    """(S, S) number of the pixel inside that is nearest to each pixel; at least one is inside."""
    _, labels = cv2.distanceTransformWithLabels(
        (~inside).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    number = np.zeros(int(labels.max()) + 1, np.int64)
    number[labels[inside]] = np.flatnonzero(inside)
    return number[labels]


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.sqrt(row_products(vectors, vectors))
    return np.asarray(vectors / np.maximum(length, 1e-9)[:, None])
