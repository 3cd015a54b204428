"""Pulling the outline of the mesh to the outline of the hand in the picture."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from hwp_bench.hands import pose_hand
from hwp_bench.hands.rotations import axis_angle_to_matrix
from hwp_bench.importers.clip_model import ClipModel, PosedClip
from hwp_bench.importers.crop import CropWindows
from hwp_bench.importers.fit_settings import FitSettings
from hwp_bench.importers.fit_terms import geman_mcclure
from hwp_bench.importers.outline import FIELD_SIZE, Outline, match_outline
from hwp_bench.importers.silhouette import boundary_vertices

#: Frames posed at once, to bound memory with fine templates.
_CHUNK = 64


def posed_vertices(model: ClipModel, chunk: int = _CHUNK) -> np.ndarray:
    """Return the vertices of every frame in the camera frame, (F, V, 3) float32 m."""
    parameters = model.parameters(np.ones(len(model.variables.turn), dtype=bool))
    betas = torch.as_tensor(parameters.betas, dtype=torch.float32)
    pieces = []
    with torch.no_grad():
        for first in range(0, parameters.frame_count, chunk):
            rows = slice(first, first + chunk)
            pose = torch.as_tensor(parameters.pose[rows], dtype=torch.float32)
            transl = torch.as_tensor(parameters.transl[rows], dtype=torch.float32)
            pieces.append(pose_hand(model.tensors, pose, betas, transl).vertices)
    return torch.cat(pieces).numpy()


class ContourEnergy:
    """Robust distance of outline vertices from the mask's outline, along their normals.

    Which vertices, and where each shall go, is decided by `rematch` between rounds of descent
    and held within a round (iterated closest points). The wrist's open end is no outline of the
    hand and never chosen.

    Args:
        fields: (F, S, S) signed distances of the masks of hand and forearm, from
            `signed_distance`; zero fields say nothing.
        usable: (F,) bool, frames that count.
        windows: where the fields lie in the whole frame.
        settings: weights and scales.
        hand_size: size of the hand in the whole frame, px.
    """

    def __init__(
        self,
        fields: np.ndarray,
        usable: np.ndarray,
        windows: CropWindows,
        settings: FitSettings,
        hand_size: float,
    ) -> None:
        self.fields = fields
        self.usable = np.asarray(usable) & (np.abs(fields).max(axis=(1, 2)) > 0)
        self.ratio = FIELD_SIZE / windows.side
        self.corners = torch.as_tensor(windows.corners, dtype=torch.float32)[:, None]
        self.scale = settings.contour_scale * hand_size * self.ratio
        self.reach = settings.contour_reach * hand_size * self.ratio
        self.weight = settings.contour_weight

    def rematch(self, model: ClipModel, update: Callable[[int], None] | None = None) -> None:
        """Choose the outline vertices of the model as it is now, and their targets."""
        faces = model.template.faces
        candidates = np.setdiff1d(np.arange(len(model.template.vertices)), boundary_vertices(faces))
        with torch.no_grad():
            vertices = torch.as_tensor(posed_vertices(model))
            pixels = self._in_field(model.pixels(vertices)).numpy()
        matches = []
        for frame, usable in enumerate(self.usable):
            matches.append(
                match_outline(pixels[frame], faces, candidates, self.fields[frame], self.reach)
                if usable
                else Outline.nothing()
            )
            if update is not None:
                update(frame + 1)
        self.index = torch.as_tensor(np.stack([match.index for match in matches]))
        self.normal = torch.as_tensor(np.stack([match.normal for match in matches]))
        self.target = torch.as_tensor(np.stack([match.target for match in matches]))
        self.rest = self._rest(model)

    def __call__(self, model: ClipModel, posed: PosedClip) -> torch.Tensor:
        """Return the energy, a scalar."""
        pixels = self._in_field(model.pixels(model.vertices(posed, self.index, self.rest)))
        # A vertex without a match has a zero normal and a zero target.
        distance = (pixels * self.normal).sum(dim=-1) - self.target
        return self.weight * geman_mcclure((distance / self.scale) ** 2, turn=4.0).sum()

    def _in_field(self, pixels: torch.Tensor) -> torch.Tensor:
        return (pixels - self.corners) * self.ratio

    def _rest(self, model: ClipModel) -> torch.Tensor:
        """Rest place (F, P, 3) of the chosen vertices; correctives are held during a round."""
        rest = model.tensors.vertices[self.index]
        basis = model.tensors.pose_basis
        if basis is None:
            return rest
        with torch.no_grad():
            feature = (axis_angle_to_matrix(model.variables.fingers) - torch.eye(3)).flatten(1)
            correctives = [
                basis[index] @ row for index, row in zip(self.index, feature, strict=True)
            ]
        return rest + torch.stack(correctives)
