"""Outlines: where the border of drawn hands lies against that of a mask, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from hwp_bench.base.arrays import surrounding
from hwp_bench.capture import Cameras
from hwp_bench.hands import HandParameters, HandTemplate, boundary_vertices, pose_hand, project
from hwp_bench.hands.raster import draw_faces
from wildghand.subject.shape import SubjectShape

# Outlines nearer to the image's edge than this say nothing, px.
_EDGE = 3
# Standard deviation of the smoothing before an outline's direction is read, px.
_SMOOTH = 1.5
# Pixels around a drawing beyond which nothing changes at its outline: the smoothing reads 4 px.
_MARGIN = 6
# Least cosine between the outward directions of drawing and mask.
_ALIKE = 0.6


@dataclass(frozen=True, eq=False)
class OutlinePoints:
    """M points of the outline of the drawn hands in one frame."""

    #: (M,) face of the mesh that each point is on.
    face: np.ndarray
    #: (M, 3) barycentric coordinates.
    mix: np.ndarray
    #: (M, 2) unit vectors in the image, outward.
    outward: np.ndarray
    #: (M,) px that the mask's border lies farther out.
    gap: np.ndarray


@dataclass(frozen=True, eq=False)
class MaskOutline:
    """The outline of a mask, read once for many drawings."""

    #: (H, W) float32 px from the border, as `outward_distance`.
    distance: np.ndarray
    #: The same, smoothed: its slope is the outward direction.
    smooth: np.ndarray
    #: Whether there is a border at all.
    bordered: bool

    @classmethod
    def of(cls, mask: np.ndarray) -> MaskOutline:
        """Read the outline of a mask, (H, W) bool, visible hand."""
        distance = outward_distance(mask)
        smooth = _smoothed(distance).astype(np.float32)
        return cls(distance.astype(np.float32), smooth, bool(mask.any() and not mask.all()))


def compare_outlines(
    pixels: np.ndarray, depth: np.ndarray, faces: np.ndarray, outline: MaskOutline
) -> OutlinePoints:
    """Compare the outline of a mesh with that of a mask.

    Args:
        pixels: (V, 2) px, the mesh in the image.
        depth: (V,) m.
        faces: (F, 3).
    """
    face, mix = draw_faces(pixels, depth, faces, outline.distance.shape)
    area = face >= 0
    # Without a border OpenCV's distances are as large as numbers get, and their slope is noise.
    if not (area.any() and outline.bordered):
        return OutlinePoints(
            face=np.zeros(0, dtype=np.int32),
            mix=np.zeros((0, 3)),
            outward=np.zeros((0, 2)),
            gap=np.zeros(0),
        )
    window = surrounding(area, _MARGIN)
    drawn = area[window]
    mine = outward_distance(drawn)
    rim = np.zeros(area.shape, dtype=bool)
    rim[window] = drawn & (mine > -0.7)
    rim[:_EDGE] = rim[-_EDGE:] = False
    rim[:, :_EDGE] = rim[:, -_EDGE:] = False
    places = np.nonzero(rim)
    within = tuple(place - part.start for place, part in zip(places, window, strict=True))
    here = _direction(_smoothed(mine), *within)
    there = _direction(outline.smooth, *places)
    gap = mine[within] - outline.distance[places]
    alike = (here * there).sum(axis=1) > _ALIKE
    rows, columns = (place[alike] for place in places)
    second = mix[rows, columns]
    return OutlinePoints(
        face=face[rows, columns],
        mix=np.column_stack([1.0 - second.sum(axis=1), second]),
        outward=here[alike],
        gap=gap[alike],
    )


def outward_distance(area: np.ndarray) -> np.ndarray:
    """(H, W) float64 px from the border of a bool area: positive outside, negative inside."""
    solid = area.astype(np.uint8)
    inside = cv2.distanceTransform(solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outside = cv2.distanceTransform(1 - solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Squares are integers; OpenCV's last bits depend on where an array lies in memory.
    inside, outside = (np.sqrt(np.rint(part.astype(np.float64) ** 2)) for part in (inside, outside))
    # Distances are between pixel centres; the border lies halfway between two of them.
    result: np.ndarray = np.where(area, 0.5 - inside, outside - 0.5)
    return result


def _smoothed(distance: np.ndarray) -> np.ndarray:
    # SciPy's filter, too, gives the same bits wherever an array lies.
    return np.asarray(gaussian_filter(distance, _SMOOTH, mode="mirror", truncate=2.7))


def _direction(smooth: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """(M, 2) unit gradients (x, y) of a smoothed distance; zeros where it has none."""
    across = smooth[rows, columns + 1] - smooth[rows, columns - 1]
    down = smooth[rows + 1, columns] - smooth[rows - 1, columns]
    length = np.sqrt(across * across + down * down)
    known = length > 1e-3
    length = np.where(known, length, 1.0)
    return (
        np.column_stack([np.where(known, across, 0.0), np.where(known, down, 0.0)])
        / length[:, None]
    )


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
            most: largest number of points, evenly spread over the outline.

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
