"""The term of the fit's energy that lays every frame onto the clip's own mean texture."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from hwp_bench.importers.shared.frames_parallel import each_frame
from hwp_bench.importers.video.clip_model import ClipModel, PosedClip
from hwp_bench.importers.video.frame_quadratic import (
    Differences,
    FrameQuadratic,
    Quadratic,
    linearised,
    no_quadratic,
)
from hwp_bench.importers.video.hand_pictures import HandPictures
from hwp_bench.importers.video.skin_texture import SkinTexture, View
from hwp_bench.importers.video.surface_motion import SurfaceMotion
from hwp_bench.importers.video.video_settings import FitSettings

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
