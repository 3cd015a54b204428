"""A fitted clip as the pictures see it: vertices and landmarks in pixels, prompts for masks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.importers.clip_model import ClipModel
from hwp_bench.importers.contour import posed_vertices
from hwp_bench.importers.crop import CropWindows
from hwp_bench.importers.segment import Prompt
from hwp_bench.importers.silhouette import boundary_vertices, draw_silhouette
from hwp_bench.importers.wrist import beyond_wrist


@dataclass(frozen=True, eq=False)
class ProjectedClip:
    """Where the model is in every frame.

    Attributes:
        vertices: (F, V, 3) float32 m, camera axes.
        pixels: (F, V, 2) float32, px of the whole frame.
        landmarks: (F, 21, 2) float32, px of the whole frame, the tracker's offsets included.
        faces: (T, 3) int64.
        ring: vertices of the open wrist.
        windows: where the crops lie.
    """

    vertices: np.ndarray
    pixels: np.ndarray
    landmarks: np.ndarray
    faces: np.ndarray
    ring: np.ndarray
    windows: CropWindows

    def in_crop(self, pixels: np.ndarray, frame: int, edge: int) -> np.ndarray:
        """Move pixels of a whole frame to its crop at `edge` px."""
        return (pixels - self.windows.corners[frame]) * (edge / self.windows.side)

    def prompt(self, frame: int, edge: int, detected: bool) -> Prompt:
        """Draw what the mesh says about a frame's crop at `edge` px."""
        pixels = self.in_crop(self.pixels[frame], frame, edge)
        return Prompt(
            draw_silhouette(pixels, self.faces, edge),
            beyond_wrist(self.vertices[frame], pixels, self.ring, edge),
            detected,
        )


def project_clip(model: ClipModel, windows: CropWindows) -> ProjectedClip:
    """Pose and project every frame of a fit as it is now."""
    vertices = posed_vertices(model)
    with torch.no_grad():
        pixels = model.pixels(torch.as_tensor(vertices)).numpy()
        landmarks = model.pixels(model.posed().landmarks).numpy()
    faces = model.template.faces
    return ProjectedClip(vertices, pixels, landmarks, faces, boundary_vertices(faces), windows)
