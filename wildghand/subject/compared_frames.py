"""Posed hands in frames whose masks are known: what their outlines are compared in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.capture import Cameras
from hwp_bench.hands import (
    HandParameters,
    HandTemplate,
    boundary_vertices,
    pose_hand,
    project,
)
from wildghand.subject.outlines import MaskOutline, OutlinePoints, compare_outlines
from wildghand.subject.shape import SubjectShape

# Points of the rest hand nearer to its open end than this are not compared: the mask ends where a
# sleeve does, m.
_WRIST = 0.015


@dataclass(frozen=True, eq=False)
class PosedFrames:
    """The hands in all F frames, as the cameras see them."""

    #: (F, V, 3) m, the vertices of all hands in the world.
    meshes: np.ndarray
    #: (F, V, 2) px, the same in the image.
    pixels: np.ndarray
    #: (F, V) m along the viewing axis.
    depths: np.ndarray
    #: (F, 16, 3, 3) rotation of each joint, for each hand.
    turns: list[np.ndarray]


class ComparedFrames:
    """Hands in F frames with masks.

    Args:
        templates: by side.
        hands: parameters of every frame of the clip, by side.
        cameras: of every frame.
        frames: (F,) numbers of those with masks.
        masks: (F, H, W) bool, visible hand.
    """

    def __init__(
        self,
        templates: Mapping[str, HandTemplate],
        hands: Mapping[str, HandParameters],
        cameras: Cameras,
        frames: np.ndarray,
        masks: np.ndarray,
    ) -> None:
        self.templates = dict(templates)
        self._outlines = [MaskOutline.of(mask) for mask in masks]
        self.viewmats, self.Ks = cameras.viewmats[frames], cameras.Ks[frames]
        self._parameters = {
            side: [
                torch.as_tensor(part, dtype=torch.float64)
                for part in (
                    hands[side].pose[frames],
                    hands[side].betas,
                    hands[side].transl[frames],
                )
            ]
            for side in templates
        }
        first = next(iter(templates.values()))
        #: Vertices of one hand.
        self.count = len(first.vertices)
        #: (T, 3) faces of all hands.
        self.faces = np.concatenate(
            [one.faces + index * self.count for index, one in enumerate(templates.values())]
        )
        self._near_wrist = _near_open_end(first)

    def __len__(self) -> int:
        return len(self._outlines)

    def posed(self, shape: SubjectShape, moves: np.ndarray | None = None) -> PosedFrames:
        """Pose the person's hands in every frame.

        Args:
            shape: of the person.
            moves: (S, F, 3) m, added to the given translations of each hand.
        """
        vertices, turns = [], []
        for index, (side, template) in enumerate(self.templates.items()):
            pose, betas, transl = self._parameters[side]
            if moves is not None:
                transl = transl + torch.as_tensor(moves[index])
            bent = shape.applied(template).to_torch(torch.float64)
            posed = pose_hand(bent, pose, betas, transl)
            vertices.append(posed.vertices)
            turns.append(posed.transforms[..., :3, :3].numpy())
        meshes = torch.cat(vertices, dim=1)
        pixels, depths = project(meshes, torch.as_tensor(self.viewmats), torch.as_tensor(self.Ks))
        return PosedFrames(meshes.numpy(), pixels.numpy(), depths.numpy(), turns)

    def compare(self, posed: PosedFrames, frame: int, most: int | None = None) -> OutlinePoints:
        """Draw the hands into a frame, and compare their outline with the mask's.

        Args:
            posed: the hands.
            frame: row of the frame, from 0.
            most: points at most, evenly spread over the outline.

        Returns:
            Points away from the wrist.
        """
        seen = compare_outlines(
            posed.pixels[frame], posed.depths[frame], self.faces, self._outlines[frame]
        )
        return self._chosen(seen, most)

    def misfit(self, shape: SubjectShape, reach: float) -> float | None:
        """How far the outlines of a person's hands are from those of the masks.

        Args:
            shape: of the person.
            reach: gap from which a point counts less and less, px.

        Returns:
            The mean over points of g^2 / (1 + (g / reach)^2), px^2; None without points.

        Source: the robust function of Geman and McClure, 1987.
        """
        posed = self.posed(shape)
        gaps = [self.compare(posed, frame).gap for frame in range(len(self))]
        squared = np.square(np.concatenate(gaps)) if gaps else np.zeros(0)
        return float((squared / (1.0 + squared / reach**2)).mean()) if squared.size else None

    def _chosen(self, seen: OutlinePoints, most: int | None) -> OutlinePoints:
        """The points away from the wrist, at most so many, evenly spread."""
        kept = np.flatnonzero(~self._near_wrist[self.faces[seen.face][:, 0] % self.count])
        if most is not None and len(kept) > most:
            kept = kept[np.linspace(0, len(kept) - 1, most).astype(np.int64)]
        return OutlinePoints(seen.face[kept], seen.mix[kept], seen.outward[kept], seen.gap[kept])


def _near_open_end(template: HandTemplate) -> np.ndarray:
    """(V,) bool: near the border of the mesh, or of a closed mesh near the wrist joint."""
    border = boundary_vertices(template.faces)
    places = template.vertices[border] if len(border) else template.joints[:1]
    distance = np.linalg.norm(template.vertices[:, None] - places[None], axis=-1).min(axis=1)
    near: np.ndarray = distance < _WRIST
    return near
