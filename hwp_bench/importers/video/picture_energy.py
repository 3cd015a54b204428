"""The term of the fit's energy that lays the lit hand, as it is drawn, onto every frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from hwp_bench.hands.anchors import vertex_normals
from hwp_bench.hands.raster import draw_faces, mix_corners
from hwp_bench.importers.shared.frames_parallel import each_frame
from hwp_bench.importers.shared.row_products import row_products
from hwp_bench.importers.video.atlas import sample
from hwp_bench.importers.video.clip_model import ClipModel, PosedClip
from hwp_bench.importers.video.frame_quadratic import (
    Differences,
    FrameQuadratic,
    Quadratic,
    linearised,
    no_quadratic,
)
from hwp_bench.importers.video.hand_pictures import HandPictures
from hwp_bench.importers.video.lit_texture import DARK, LitTexture, SeenTexels
from hwp_bench.importers.video.surface_motion import SurfaceMotion
from hwp_bench.importers.video.texture_energy import LEAST_PIXELS
from hwp_bench.importers.video.video_settings import FitSettings

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
