"""The frames of a clip as the fit of one hand sees them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from hwp_bench.hands.anchors import vertex_normals
from hwp_bench.hands.raster import draw_faces, mix_corners
from hwp_bench.importers.shared.frames import CropWindows, each_frame
from hwp_bench.importers.video.model import (
    FRAME_VARIABLES,
    ClipModel,
    PosedClip,
    SurfaceMotion,
    frame_variables,
    posed_vertices,
)
from hwp_bench.importers.video.residuals import FitSettings
from hwp_bench.importers.video.texture import (
    DARK,
    LitTexture,
    SeenTexels,
    SkinTexture,
    View,
    row_products,
    sample,
)


@dataclass(frozen=True, eq=False)
class HandPictures:
    """Images of a clip, and what is this hand's in them; S is the edge of the images.

    Attributes:
        images: (F, S, S, 3) uint8 RGB.
        masks: (F, S, S) uint8 coverage of the hand.
        usable: (F,) bool, frames that count.
        windows: where the images lie in the whole frame.
        hand_size: size of the hand in the whole frame, px.
        other: (F, S, S) uint8 coverage of another hand, or None.
    """

    images: np.ndarray
    masks: np.ndarray
    usable: np.ndarray
    windows: CropWindows
    hand_size: float
    other: np.ndarray | None = None

    @property
    def ratio(self) -> float:
        """Px of the images to one px of the whole frame."""
        return float(self.images.shape[1] / self.windows.side)

    @property
    def frames(self) -> list[int]:
        """The frames that count."""
        return [int(frame) for frame in np.flatnonzero(self.usable)]

    def placed(self, model: ClipModel) -> tuple[np.ndarray, np.ndarray]:
        """Place a model in the images: its vertices (F, V, 3) m, and (F, V, 2) px of them."""
        vertices = posed_vertices(model)
        with torch.no_grad():
            pixels = model.pixels(torch.as_tensor(vertices)).numpy()
        inside = (pixels - self.windows.corners[:, None]) * self.ratio
        return vertices, inside.astype(np.float32)


# Rows in a product of matrices.
_BLOCK = 24


@dataclass(frozen=True, eq=False)
class Differences:
    """A frame compared with what is expected of it, at P pixels; C channels.

    Attributes:
        face: (P,) the face that each pixel shows, or that is nearest to it.
        mix: (P, 2) barycentric coordinates as `draw_faces` returns them.
        error: (P, C) the frame less what is expected.
        across: (P, C) how the picture changes to the right, by px of the images.
        down: (P, C) the same downwards.
        trust: (P,) weights.
    """

    face: np.ndarray
    mix: np.ndarray
    error: np.ndarray
    across: np.ndarray
    down: np.ndarray
    trust: np.ndarray


#: Curvature (51, 51) and slope (51,) of one frame.
Quadratic = tuple[np.ndarray, np.ndarray]


def no_quadratic() -> Quadratic:
    """Return that of a frame that says nothing."""
    return np.zeros((FRAME_VARIABLES,) * 2), np.zeros(FRAME_VARIABLES)


def linearised(
    motion: SurfaceMotion, frame: int, faces: np.ndarray, found: Differences, ratio: float
) -> Quadratic:
    """Differentiate half the weighed squared differences by the variables of their frame.

    A surface that moves by u takes its picture with it, so that a pixel gets less of what is
    ahead of it: the difference grows by the picture's slope times u.

    Args:
        motion: how vertices move in the whole frame.
        frame: which frame.
        faces: (T, 3) of the hand.
        found: the differences.
        ratio: px of the images to one px of the whole frame.
    """
    shares = np.stack([1.0 - found.mix.sum(axis=1), found.mix[:, 0], found.mix[:, 1]], axis=1)
    corners = faces[found.face].ravel()
    count = int(faces.max()) + 1

    def collected(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        spread = shares * (found.trust * row_products(first, second))[:, None]
        return np.bincount(corners, spread.ravel(), minlength=count)

    across, down = found.across, found.down
    xx, xy, yy = collected(across, across), collected(across, down), collected(down, down)
    used = np.flatnonzero(xx + yy > 0)
    rates = motion.by_variables(frame, used) * ratio
    xx, xy, yy = (part[used, None] for part in (xx, xy, yy))
    x, y = rates[:, 0], rates[:, 1]
    weighed = np.stack([xx * x + xy * y, xy * x + yy * y], axis=1)
    pull = np.stack([collected(part, found.error)[used] for part in (across, down)], axis=1)
    return _summed(rates, weighed), np.einsum("pak,pa->k", rates, pull)


class FrameQuadratic:
    """An energy that is quadratic in the variables of each frame; zero where it was linearised.

    Args:
        model: the clip, as it is now.
        usable: frames that count.
        found: their curvatures and slopes, in this order.
        weight: of the energy.
    """

    def __init__(
        self, model: ClipModel, usable: Sequence[int], found: Iterable[Quadratic], weight: float
    ) -> None:
        self._weight = weight
        self._start = frame_variables(model.variables).detach().clone()
        frames = len(self._start)
        curvature = np.zeros((frames, FRAME_VARIABLES, FRAME_VARIABLES))
        slope = np.zeros((frames, FRAME_VARIABLES))
        for frame, (bent, steep) in zip(usable, found, strict=True):
            curvature[frame], slope[frame] = bent, steep
        self._curvature = torch.as_tensor(curvature, dtype=torch.float32)
        self._slope = torch.as_tensor(slope, dtype=torch.float32)

    def __call__(self, model: ClipModel) -> torch.Tensor:
        """Return the energy, a scalar."""
        step = frame_variables(model.variables) - self._start
        bent = (self._curvature @ step[..., None])[..., 0]
        return self._weight * (step * (0.5 * bent + self._slope)).sum()


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


#: Pixels of a frame below which its texture says nothing.
LEAST_PIXELS = 50


class TextureEnergy:
    """Difference of each frame from the mean texture of all frames, to second order in the poses.

    `rematch` collects the texture with the model as it is and linearises the difference of each
    pixel; within a round of descent the energy is then a quadratic function of the frame's
    variables, which costs next to nothing. An outline cannot tell how a finger is turned about
    its axis, or a palm about an axis in the image; wrinkles, nails and veins can.

    Args:
        pictures: of the clip.
        settings: weights and scales.
        model: the clip.
    """

    def __init__(self, pictures: HandPictures, settings: FitSettings, model: ClipModel) -> None:
        self._pictures = pictures
        size = pictures.hand_size * pictures.ratio
        self._scale = settings.texture_scale
        self._faces = model.template.faces
        # The energy of a whole hand is the same in images of any size.
        self._weight = settings.texture_weight / size**2
        self.texture = SkinTexture(model.template, settings.light_breadth * size)

    def rematch(self, model: ClipModel) -> None:
        """Collect the texture and linearise the differences, with the model as it is now."""
        images, masks, usable = self._pictures.images, self._pictures.masks, self._pictures.frames
        vertices, pixels = self._pictures.placed(model)
        motion = SurfaceMotion(model)

        def view(frame: int) -> View:
            return self.texture.view(images[frame], masks[frame], vertices[frame], pixels[frame])

        def seen(frame: int) -> tuple[np.ndarray, np.ndarray]:
            return self.texture.seen(view(frame), vertices[frame], pixels[frame])

        for values, weights in each_frame(seen, usable):
            self.texture.add(values, weights)
        self.texture.finish()

        def linear(frame: int) -> Quadratic:
            return self._linearised(motion, frame, view(frame))

        found = each_frame(linear, usable)
        self._energy = FrameQuadratic(model, usable, found, self._weight)

    def __call__(self, model: ClipModel, posed: PosedClip) -> torch.Tensor:
        """Return the energy, a scalar; zero where it was linearised."""
        return self._energy(model)

    def _linearised(self, motion: SurfaceMotion, frame: int, view: View) -> Quadratic:
        """Curvature and slope of one frame, before the weight."""
        expected, core = self.texture.expected(view)
        if np.count_nonzero(core) < LEAST_PIXELS:
            return no_quadratic()
        error = self.texture.without_light(view.detail - expected, core)[core]
        # The mean of both images' gradients makes the step of second order.
        # Benhimane and Malis, "Homography-based 2D visual tracking and servoing", 2007.
        both = view.detail + expected
        across, down = (
            cv2.Scharr(both, cv2.CV_32F, *axis)[core] / 64.0 for axis in ((1, 0), (0, 1))
        )
        trust = 1.0 / (1.0 + (error / (2.0 * self._scale)) ** 2) ** 2 / self._scale**2
        found = Differences(
            face=view.face[core],
            mix=view.mix[core],
            error=error[:, None],
            across=across[:, None],
            down=down[:, None],
            trust=trust,
        )
        return linearised(motion, frame, self._faces, found, self._pictures.ratio)


# Pixels next to a border mix two surfaces.
_BORDER = np.ones((3, 3), np.uint8)
# Both pictures are compared this far off hand and mask, too: their borders say where a hand ends.
_REACH = np.ones((5, 5), np.uint8)
# px, deviation of the Gaussian that both are smoothed by: a drawn border is a step.
_SMOOTH = 1.0
# m, how much deeper than the nearest surface a texel may lie and still be seen.
_SEEN = 0.004
# Cosine of the angle to the viewer from which a surface counts.
_LEAST_FACING = 0.25


@dataclass(frozen=True, eq=False)
class _Drawn:
    """A frame's mesh: nearest face (S, S), mix (S, S, 2), vertices' places, px, and normals."""

    vertices: np.ndarray
    pixels: np.ndarray
    normals: np.ndarray
    face: np.ndarray
    mix: np.ndarray


class PictureEnergy:
    """Difference of each frame from the hand drawn in its colours and light, in second order.

    `rematch` fits the colours with the model as it is, draws each frame with them, and linearises
    the difference of each pixel. Unlike the texture's term it compares whole pictures: with what
    is as broad as light, the borders of fingers before a palm, and the hand's own border, beyond
    which both are black.

    Args:
        pictures: of the clip; around another hand nothing is compared.
        settings: weight and scale.
        model: the clip.
    """

    def __init__(self, pictures: HandPictures, settings: FitSettings, model: ClipModel) -> None:
        self._pictures = pictures
        self._scale = settings.picture_scale
        # The energy of a whole hand is the same in images of any size.
        self._weight = settings.picture_weight / (pictures.hand_size * pictures.ratio) ** 2
        self._faces = model.template.faces
        self.texture = LitTexture(model.template, len(pictures.images))

    def rematch(self, model: ClipModel) -> None:
        """Fit the colours and linearise the differences, with the model as it is now."""
        usable = self._pictures.frames
        vertices, pixels = self._pictures.placed(model)
        motion = SurfaceMotion(model)

        # Each frame is drawn twice: all drawings together would need 1 MB for each frame.
        def seen(frame: int) -> SeenTexels:
            return self._seen(frame, self._draw(vertices[frame], pixels[frame]))

        def linear(frame: int) -> Quadratic:
            found = self._differences(frame, self._draw(vertices[frame], pixels[frame]))
            if found is None:
                return no_quadratic()
            return linearised(motion, frame, self._faces, found, self._pictures.ratio)

        if usable:
            self.texture.fit(dict(zip(usable, each_frame(seen, usable), strict=True)))
        self._energy = FrameQuadratic(model, usable, each_frame(linear, usable), self._weight)

    def __call__(self, model: ClipModel, posed: PosedClip) -> torch.Tensor:
        """Return the energy, a scalar; zero where it was linearised."""
        return self._energy(model)

    def _draw(self, vertices: np.ndarray, pixels: np.ndarray) -> _Drawn:
        size = self._pictures.images.shape[1:3]
        face, mix = draw_faces(pixels, vertices[:, 2], self._faces, (size[0], size[1]))
        faces = torch.as_tensor(self._faces, dtype=torch.int64)
        normals = vertex_normals(torch.as_tensor(vertices), faces).numpy()
        return _Drawn(vertices, pixels, normals, face, mix)

    def _seen(self, frame: int, drawn: _Drawn) -> SeenTexels:
        inside = drawn.face >= 0
        depth = np.full(inside.shape, np.inf, np.float32)
        depth[inside] = self._mixed(drawn.vertices[:, 2:], drawn, inside)[:, 0]
        core = cv2.erode((inside & (self._pictures.masks[frame] > 127)).astype(np.float32), _BORDER)
        atlas = self.texture.atlas
        places, points = atlas.on_surface(drawn.pixels), atlas.on_surface(drawn.vertices)
        normals = _unit(atlas.on_surface(drawn.normals))
        facing = -row_products(normals, _unit(points))
        nearest = sample(cv2.erode(depth, _BORDER), places, cv2.INTER_NEAREST)
        here = (facing > _LEAST_FACING) & (np.abs(nearest - points[:, 2]) < _SEEN)
        shown = np.flatnonzero(here & (sample(core, places, cv2.INTER_NEAREST) > 0))
        logs = np.log(self._pictures.images[frame].astype(np.float32) / 255.0 + DARK)
        return SeenTexels(
            texels=shown.astype(np.int32),
            logs=sample(logs, places[shown]),
            normals=normals[shown],
            weights=facing[shown] ** 2,
        )

    def _differences(self, frame: int, drawn: _Drawn) -> Differences | None:
        inside = drawn.face >= 0
        if np.count_nonzero(inside) < LEAST_PIXELS or not self._pictures.masks[frame].any():
            return None
        expected = np.zeros((*inside.shape, 3), np.float32)
        known = np.zeros(inside.shape, np.float32)
        expected[inside], known[inside] = self.texture.expected(
            frame,
            drawn.face[inside],
            drawn.mix[inside],
            _unit(self._mixed(drawn.normals, drawn, inside)),
        )
        coverage = self._pictures.masks[frame].astype(np.float32) / 255.0
        image = self._pictures.images[frame].astype(np.float32) / 255.0 * coverage[..., None]
        expected, image = (cv2.GaussianBlur(each, (0, 0), _SMOOTH) for each in (expected, image))
        near = cv2.dilate((inside | (coverage > 0.5)).astype(np.uint8), _REACH) > 0
        if self._pictures.other is not None:
            near &= cv2.dilate(self._pictures.other[frame], _REACH) == 0
        error = (image - expected)[near]
        squared = row_products(error, error) / (3.0 * (2.0 * self._scale) ** 2)
        # Pixels off the hand move as the nearest pixel on it: its border moves with it.
        nearest = _nearest(inside)[near]
        trust = known.ravel()[nearest] / (1.0 + squared) ** 2 / self._scale**2
        # The mean of both pictures' slopes, as in the texture's term.
        both = 0.5 * (image + expected)
        across, down = (cv2.Scharr(both, cv2.CV_32F, *axis) / 32.0 for axis in ((1, 0), (0, 1)))
        return Differences(
            face=drawn.face.ravel()[nearest],
            mix=drawn.mix.reshape(-1, 2)[nearest],
            error=error,
            across=across[near],
            down=down[near],
            trust=trust,
        )

    def _mixed(self, values: np.ndarray, drawn: _Drawn, inside: np.ndarray) -> np.ndarray:
        return mix_corners(values, self._faces, drawn.face[inside], drawn.mix[inside])


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
