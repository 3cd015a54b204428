"""Hands drawn into frames by their parameters: silhouettes, surface cells and normals of pixels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.hands.anchors import vertex_normals
from hwp_bench.hands.parameters import HandParameters
from hwp_bench.hands.raster import draw_faces, mix_corners
from hwp_bench.hands.skinning import pose_hand, project
from hwp_bench.hands.template import HandTemplate

# Frames that are posed at a time, so that memory does not grow with the clip.
_CHUNK = 32


@dataclass(frozen=True, eq=False)
class Footprint:
    """The hands in one frame, as their parameters place them; P pixels show them."""

    #: (H, W) bool.
    silhouette: np.ndarray
    #: (P,) int32, row-major pixel numbers of the silhouette, ascending.
    pixels: np.ndarray
    #: (P,) int32 cell of the surface that the pixel shows.
    cells: np.ndarray
    #: (P, 3) float32 unit normals, world axes.
    normals: np.ndarray
    #: (P,) float32 cosine between the normal and the direction to the camera.
    facing: np.ndarray
    #: Median path of the visible points across the image since the frame before, px.
    motion: float


class HandSurfaces:
    """The surfaces of a capture's hands, cut into cells: the places that frames have in common.

    Args:
        templates: by side.
        patch_size: edge of a cell, m.
    """

    def __init__(self, templates: Mapping[str, HandTemplate], patch_size: float) -> None:
        self._tensors = {side: template.to_torch() for side, template in templates.items()}
        faces, keys, start = [], [], 0
        for number, template in enumerate(templates.values()):
            faces.append(template.faces + start)
            start += len(template.vertices)
            rest = (template.vertices - template.vertices.min(axis=0)) / patch_size
            # Hands lie far apart in this grid, so that they share no cell.
            keys.append(rest + np.array([0.0, 0.0, number * (rest[:, 2].max() + 2.0)]))
        self._faces = np.concatenate(faces).astype(np.int64)
        self._places = np.concatenate(keys).astype(np.float32)
        self._grid = np.floor(self._places.max(axis=0)).astype(np.int64) + 1
        #: (C, 3) float32 mean outward normal of every cell on the rest hand, length 1; zeros
        #: where the cell holds no face. Most cells hold none.
        self.cell_normals = self._rest_normals(templates)

    def _rest_normals(self, templates: Mapping[str, HandTemplate]) -> np.ndarray:
        normals = np.concatenate(
            [
                vertex_normals(_real(template.vertices), torch.from_numpy(template.faces)).numpy()
                for template in templates.values()
            ]
        )
        result = np.zeros((int(self._grid.prod()), 3))
        # Corners and centre of every face: cells are larger than faces of any template.
        for weights in np.concatenate([np.full((1, 3), 1 / 3), 0.8 * np.eye(3) + 0.2 / 3]):
            places = np.einsum("k,tkc->tc", weights, self._places[self._faces])
            mixed = np.einsum("k,tkc->tc", weights, normals[self._faces])
            np.add.at(result, self._cells(places), mixed)
        length = np.linalg.norm(result, axis=1, keepdims=True)
        return (result / np.maximum(length, 1e-9)).astype(np.float32)

    def _cells(self, places: np.ndarray) -> np.ndarray:
        grid = np.clip(places.astype(np.int64), 0, self._grid - 1)
        return np.ravel_multi_index(tuple(grid.T), tuple(self._grid))

    def footprints(
        self,
        hands: Mapping[str, HandParameters],
        Ks: np.ndarray,
        viewmats: np.ndarray,
        frames: np.ndarray,
        size: tuple[int, int],
    ) -> Iterator[Footprint]:
        """Draw the hands in some frames, in their order.

        Args:
            hands: parameters of every frame, by side.
            Ks: (F, 3, 3) px.
            viewmats: (F, 4, 4).
            frames: (R,) which frames.
            size: height and width of the images.
        """
        before: tuple[int, np.ndarray] | None = None
        for start in range(0, len(frames), _CHUNK):
            part = frames[start : start + _CHUNK]
            vertices, normals = self._pose(hands, part)
            places, depth = project(vertices, _real(viewmats[part]), _real(Ks[part]))
            centres = -np.einsum("fji,fj->fi", viewmats[part, :3, :3], viewmats[part, :3, 3])
            away = _real(centres)[:, None] - vertices
            away = away / away.norm(dim=-1, keepdim=True).clamp_min(1e-9)
            attributes = torch.cat([normals, (normals * away).sum(dim=-1, keepdim=True)], dim=-1)
            for row, frame in enumerate(part.tolist()):
                here = places[row].numpy()
                motion = 0.0
                if before is not None and before[0] == frame - 1:
                    way = np.linalg.norm(here - before[1], axis=1)
                    motion = float(np.median(way))
                before = (frame, here)
                yield self._draw(here, depth[row].numpy(), attributes[row].numpy(), size, motion)

    def _pose(
        self, hands: Mapping[str, HandParameters], frames: np.ndarray
    ) -> tuple[torch.Tensor, torch.Tensor]:
        vertices, normals = [], []
        for side, tensors in self._tensors.items():
            hand = hands[side]
            posed = pose_hand(
                tensors, _real(hand.pose[frames]), _real(hand.betas), _real(hand.transl[frames])
            ).vertices
            vertices.append(posed)
            normals.append(vertex_normals(posed, tensors.faces))
        return torch.cat(vertices, dim=1), torch.cat(normals, dim=1)

    def _draw(
        self,
        places: np.ndarray,
        depth: np.ndarray,
        attributes: np.ndarray,
        size: tuple[int, int],
        motion: float,
    ) -> Footprint:
        face, mix = draw_faces(places, depth, self._faces, size)
        silhouette = face >= 0
        pixels = np.flatnonzero(silhouette)
        shown, mixed = face.reshape(-1)[pixels], mix.reshape(-1, 2)[pixels]
        values = mix_corners(
            np.concatenate([attributes, self._places], axis=1), self._faces, shown, mixed
        )
        normals, facing, place = values[:, :3], values[:, 3], values[:, 4:]
        length = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
        return Footprint(
            silhouette=silhouette,
            pixels=pixels.astype(np.int32),
            cells=self._cells(place).astype(np.int32),
            normals=normals / length,
            facing=facing / length[:, 0],
            motion=motion,
        )


def _real(values: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(np.asarray(values), dtype=torch.float32)
