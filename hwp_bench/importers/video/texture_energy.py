"""The term of the fit's energy that lays every frame onto the clip's own mean texture."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from hwp_bench.importers.shared.frames_parallel import each_frame
from hwp_bench.importers.shared.windows import CropWindows
from hwp_bench.importers.video.clip_model import ClipModel, PosedClip, posed_vertices
from hwp_bench.importers.video.skin_texture import SkinTexture, View
from hwp_bench.importers.video.surface_motion import (
    FRAME_VARIABLES,
    SurfaceMotion,
    frame_variables,
)
from hwp_bench.importers.video.video_settings import FitSettings

#: Pixels of a frame below which its texture says nothing.
LEAST_PIXELS = 50
# Rows in a product of matrices.
_BLOCK = 24


class TextureEnergy:
    """Difference of each frame from the mean texture of all frames, to second order in the poses.

    `rematch` collects the texture with the model as it is and linearises the difference of each
    pixel; within a round of descent the energy is then a quadratic function of the frame's
    variables, which costs next to nothing. An outline cannot tell how a finger is turned about
    its axis, or a palm about an axis in the image; wrinkles, nails and veins can.

    Args:
        images: (F, S, S, 3) uint8 RGB.
        masks: (F, S, S) uint8 coverage of the hand.
        usable: (F,) bool, frames that count.
        windows: where the images lie in the whole frame.
        settings: weights and scales.
        hand_size: size of the hand in the whole frame, px.
        model: the clip.
    """

    def __init__(
        self,
        images: np.ndarray,
        masks: np.ndarray,
        usable: np.ndarray,
        windows: CropWindows,
        settings: FitSettings,
        hand_size: float,
        model: ClipModel,
    ) -> None:
        self._images, self._masks = images, masks
        self._usable = np.flatnonzero(usable)
        self._corners = windows.corners[:, None]
        self._ratio = images.shape[1] / windows.side
        size = hand_size * self._ratio
        self._scale = settings.texture_scale
        # The energy of a whole hand is the same in images of any size.
        self._weight = settings.texture_weight / size**2
        self.texture = SkinTexture(model.template, settings.light_breadth * size)

    def rematch(self, model: ClipModel) -> None:
        """Collect the texture and linearise the differences, with the model as it is now."""
        vertices = posed_vertices(model)
        with torch.no_grad():
            pixels = model.pixels(torch.as_tensor(vertices)).numpy()
        pixels = ((pixels - self._corners) * self._ratio).astype(np.float32)
        motion = SurfaceMotion(model)

        def view(frame: int) -> View:
            return self.texture.view(
                self._images[frame], self._masks[frame], vertices[frame], pixels[frame]
            )

        def seen(frame: int) -> tuple[np.ndarray, np.ndarray]:
            return self.texture.seen(view(frame), vertices[frame], pixels[frame])

        for values, weights in each_frame(seen, self._usable.tolist()):
            self.texture.add(values, weights)
        self.texture.finish()

        def linear(frame: int) -> tuple[np.ndarray, np.ndarray]:
            return self._linearised(model, motion, frame, view(frame))

        frames = len(self._images)
        curvature = np.zeros((frames, FRAME_VARIABLES, FRAME_VARIABLES))
        slope = np.zeros((frames, FRAME_VARIABLES))
        for frame, found in zip(
            self._usable, each_frame(linear, self._usable.tolist()), strict=True
        ):
            curvature[frame], slope[frame] = found
        self._curvature = torch.as_tensor(curvature, dtype=torch.float32)
        self._slope = torch.as_tensor(slope, dtype=torch.float32)
        self._start = frame_variables(model.variables).detach().clone()

    def __call__(self, model: ClipModel, posed: PosedClip) -> torch.Tensor:
        """Return the energy, a scalar; zero where it was linearised."""
        step = frame_variables(model.variables) - self._start
        bent = (self._curvature @ step[..., None])[..., 0]
        return self._weight * (step * (0.5 * bent + self._slope)).sum()

    def _linearised(
        self, model: ClipModel, motion: SurfaceMotion, frame: int, view: View
    ) -> tuple[np.ndarray, np.ndarray]:
        """Curvature (51, 51) and slope (51,) of one frame, before the weight."""
        expected, core = self.texture.expected(view)
        if np.count_nonzero(core) < LEAST_PIXELS:
            return np.zeros((FRAME_VARIABLES,) * 2), np.zeros(FRAME_VARIABLES)
        error = self.texture.without_light(view.detail - expected, core)[core]
        # The mean of both images' gradients makes the step of second order.
        # Benhimane and Malis, "Homography-based 2D visual tracking and servoing", 2007.
        both = view.detail + expected
        across, down = (
            cv2.Scharr(both, cv2.CV_32F, *axis)[core] / 64.0 for axis in ((1, 0), (0, 1))
        )
        trust = 1.0 / (1.0 + (error / (2.0 * self._scale)) ** 2) ** 2 / self._scale**2
        mix = view.mix[core]
        shares = np.stack([1.0 - mix.sum(axis=1), mix[:, 0], mix[:, 1]], axis=1)
        corners = model.template.faces[view.face[core]].ravel()
        count = len(model.template.vertices)

        def collected(values: np.ndarray) -> np.ndarray:
            spread = (shares * (trust * values)[:, None]).ravel()
            return np.bincount(corners, spread, minlength=count)

        xx, xy, yy = (collected(p) for p in (across * across, across * down, down * down))
        used = np.flatnonzero(xx + yy > 0)
        rates = motion.by_variables(frame, used) * self._ratio
        xx, xy, yy = (part[used, None] for part in (xx, xy, yy))
        x, y = rates[:, 0], rates[:, 1]
        weighed = np.stack([xx * x + xy * y, xy * x + yy * y], axis=1)
        pull = np.stack([collected(across * error)[used], collected(down * error)[used]], axis=1)
        return _summed(rates, weighed), np.einsum("pak,pa->k", rates, pull)


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
