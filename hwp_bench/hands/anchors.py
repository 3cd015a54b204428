"""The surface of a posed hand: normals, anchors that carry Gaussians, what an image shows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from hwp_bench.base.errors import BadHandModel, UsageError
from hwp_bench.hands.raster import draw_faces, mix_corners
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.hands.skinning import pose_hand, project
from hwp_bench.hands.template import HandTemplate

if TYPE_CHECKING:
    import trimesh


#: Number of Gaussians of a hand in the paper: the vertices of MANO-HD.
DEFAULT_ANCHOR_COUNT = 49281

# Step of the two-dimensional additive sequence with the best known spread (Roberts, "R2"):
# powers of the real root of x^3 = x + 1.
_R2_STEP = 1.0 / 1.32471795724474602596 ** np.array([1.0, 2.0])

# Squared length, m^4 for face normals and m^2 for edges, under which a direction is noise.
_TINY = 1e-30


@dataclass(frozen=True, eq=False)
class SurfaceAnchors:
    """N points given by a face and barycentric coordinates; they move with the mesh.

    The arrays are numpy as made and tensors after `to_torch`; both work everywhere.
    """

    #: (N,) int64.
    face_index: np.ndarray | torch.Tensor
    #: (N, 3), not negative, rows sum to 1.
    barycentric: np.ndarray | torch.Tensor

    def __len__(self) -> int:
        return len(self.face_index)

    def to_torch(
        self, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
    ) -> SurfaceAnchors:
        """Return the same anchors as tensors, so that later calls copy nothing."""
        return SurfaceAnchors(
            face_index=torch.as_tensor(self.face_index, device=device),
            barycentric=torch.as_tensor(self.barycentric, dtype=dtype, device=device),
        )


def sample_surface(
    template: HandTemplate, count: int = DEFAULT_ANCHOR_COUNT, seed: int = 0
) -> SurfaceAnchors:
    """Spread anchors evenly over the rest surface; the same arguments give the same anchors.

    Every face gets its share of the area, rounded up or down (systematic sampling); within a
    face the points follow a low-discrepancy sequence with a random start.

    Args:
        template: the hand.
        count: number of anchors, at least 1.
        seed: any non-negative integer.

    Raises:
        UsageError: `count` is below 1.
        BadHandModel: the surface has no area.

    Source: the square-to-triangle map is Heitz, "A Low-Distortion Map Between Triangle and
    Square" (2019); the sequence is Roberts' R2.
    """
    if count < 1:
        said = f"{count} anchors are not possible"
        raise UsageError(said, field="count", remedy="Use at least 1.")
    random = np.random.default_rng(seed)
    corners = template.vertices[template.faces]
    areas = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    filled = np.cumsum(areas)
    if not filled[-1] > 0.0:
        raise BadHandModel("the surface has no area", field="template.faces")
    bounds = np.floor(count * (filled / filled[-1]) + random.uniform()).astype(np.int64)
    shares = np.diff(bounds, prepend=0)
    face_index = np.repeat(np.arange(len(areas)), shares)
    position = np.arange(count) - np.repeat(bounds - shares, shares)
    start = random.uniform(size=(len(areas), 2))[face_index]
    x, y = ((start + position[:, None] * _R2_STEP) % 1.0).T
    upper = y > x
    first = np.where(upper, 0.5 * x, x - 0.5 * y)
    second = np.where(upper, y - 0.5 * x, 0.5 * y)
    mix = np.stack([first, second, 1.0 - first - second], axis=1)
    return SurfaceAnchors(face_index, mix)


def anchor_positions(
    vertices: torch.Tensor, faces: torch.Tensor, anchors: SurfaceAnchors
) -> torch.Tensor:
    """Compute the places of N anchors of vertices (B, V, 3) or (V, 3) m, differentiably.

    Returns:
        (B, N, 3) or (N, 3) m.
    """
    corners, mix = _gather(faces, anchors, vertices)
    return _mix(vertices, corners, mix)


def anchor_normals(
    vertices: torch.Tensor, faces: torch.Tensor, anchors: SurfaceAnchors
) -> torch.Tensor:
    """Compute smooth outward unit normals at the anchors from the vertex normals.

    Arguments as in `anchor_positions`. Where the vertex normals cancel, the normal is (0, 0, 1).
    """
    corners, mix = _gather(faces, anchors, vertices)
    mixed = _mix(vertex_normals(vertices, faces), corners, mix)
    return unit_or(mixed, _forward(vertices))


def anchor_frames(
    vertices: torch.Tensor, faces: torch.Tensor, anchors: SurfaceAnchors
) -> torch.Tensor:
    """Compute a frame at each anchor that turns with the surface.

    The columns are tangent, bitangent and smooth normal. The tangent is the first edge of the
    anchor's face, made perpendicular to the normal: a material direction, so that it follows
    every motion of the skin. Arguments as in `anchor_positions`.

    Returns:
        (B, N, 3, 3) or (N, 3, 3) rotation matrices, also on degenerate faces.
    """
    normal = anchor_normals(vertices, faces, anchors)
    # Many anchors share a face: subtract once for each face.
    edges = vertices[..., faces[:, 1], :] - vertices[..., faces[:, 0], :]
    edge = edges[..., torch.as_tensor(anchors.face_index, device=faces.device), :]
    along = edge - (edge * normal).sum(dim=-1, keepdim=True) * normal
    tangent = unit_or(along, _any_perpendicular(normal.detach()))
    bitangent = torch.linalg.cross(normal, tangent)
    return torch.stack([tangent, bitangent, normal], dim=-1)


def anchor_uv(template: HandTemplate, anchors: SurfaceAnchors) -> np.ndarray:
    """Return the anchors' texture coordinates: (N, 2) in [0, 1], origin at the bottom left."""
    faces = torch.as_tensor(anchors.face_index).cpu().numpy()
    mix = torch.as_tensor(anchors.barycentric).cpu().double().numpy()
    return (template.uv[template.face_uv[faces]] * mix[..., None]).sum(axis=1)


def vertex_normals(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Compute outward unit normals at vertices (B, V, 3) or (V, 3): face normals by area.

    A vertex without a face of any area gets (0, 0, 1) and no gradient.
    """
    corners = vertices[..., faces, :]
    edges = corners[..., 1:, :] - corners[..., :1, :]
    crosses = torch.linalg.cross(edges[..., 0, :], edges[..., 1, :])
    sums = torch.zeros_like(vertices)
    for corner in faces.unbind(dim=1):
        sums = sums.index_add(-2, corner, crosses)
    return unit_or(sums, _forward(vertices))


def _forward(like: torch.Tensor) -> torch.Tensor:
    """(0, 0, 1), made where it is needed: handing numbers over to a device would wait for it."""
    return torch.eye(3, dtype=like.dtype, device=like.device)[2]


def unit_or(vectors: torch.Tensor, fallback: torch.Tensor) -> torch.Tensor:
    """Scale vectors to length one; a zero vector becomes the fallback, with zero gradient."""
    squared = (vectors * vectors).sum(dim=-1, keepdim=True)
    usable = squared > _TINY
    length = torch.where(usable, squared, torch.ones_like(squared)).sqrt()
    return torch.where(usable, vectors / length, fallback)


def to_trimesh(vertices: torch.Tensor | np.ndarray, faces: Any) -> trimesh.Trimesh:
    """Make a trimesh mesh of vertices (V, 3) and faces (F, 3), which are kept as they are."""
    import trimesh

    if isinstance(vertices, torch.Tensor):
        vertices = vertices.detach().cpu().numpy()
    return trimesh.Trimesh(np.asarray(vertices), np.asarray(faces), process=False)


def _gather(
    faces: torch.Tensor, anchors: SurfaceAnchors, like: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    index = torch.as_tensor(anchors.face_index, device=faces.device)
    mix = torch.as_tensor(anchors.barycentric, dtype=like.dtype, device=like.device)
    return faces[index], mix


def _mix(values: torch.Tensor, corners: torch.Tensor, mix: torch.Tensor) -> torch.Tensor:
    total = values[..., corners[:, 0], :] * mix[:, :1]
    for corner in (1, 2):
        total = total + values[..., corners[:, corner], :] * mix[:, corner : corner + 1]
    return total


def _any_perpendicular(normal: torch.Tensor) -> torch.Tensor:
    axes = torch.eye(3, dtype=normal.dtype, device=normal.device)
    axis = axes[normal.abs().argmin(dim=-1)]
    across = torch.linalg.cross(normal, axis)
    return across / across.norm(dim=-1, keepdim=True)


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
    """The surfaces of a capture's hands, cut into cells (of edge `patch_size`, m).

    Cells are the places that frames have in common.
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
        """Draw the hands in some frames (R,), in their order; Ks (F, 3, 3), viewmats (F, 4, 4)."""
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
