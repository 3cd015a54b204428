"""The surface of a posed hand: normals, and anchors, the points that carry Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from hwp_bench.base.errors import BadHandModel, UsageError
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
        raise UsageError(
            f"{count} anchors are not possible", field="count", remedy="Use at least 1."
        )
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
    square = (start + position[:, None] * _R2_STEP) % 1.0
    return SurfaceAnchors(face_index, _square_to_triangle(square))


def anchors_from_vertices(template: HandTemplate) -> SurfaceAnchors:
    """Make one anchor on every vertex, in the order of the vertices.

    Raises:
        UsageError: a vertex belongs to no face.
    """
    count = len(template.vertices)
    first = np.full(count, -1, dtype=np.int64)
    flat = template.faces.reshape(-1)
    first[flat[::-1]] = np.arange(len(flat))[::-1]
    if (first < 0).any():
        raise UsageError(
            f"vertex {int(np.argmin(first))} belongs to no face", field="template.faces"
        )
    return SurfaceAnchors(first // 3, np.eye(3)[first % 3])


def anchor_positions(
    vertices: torch.Tensor, faces: torch.Tensor, anchors: SurfaceAnchors
) -> torch.Tensor:
    """Compute the places of the anchors.

    Args:
        vertices: (B, V, 3) or (V, 3) m.
        faces: (F, 3) int64.
        anchors: N anchors.

    Returns:
        (B, N, 3) or (N, 3) m; differentiable in `vertices`.
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
    every motion of the skin.

    Arguments as in `anchor_positions`.

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
    corners = template.uv[template.face_uv[np.asarray(anchors.face_index)]]
    return (corners * np.asarray(anchors.barycentric, dtype=np.float64)[..., None]).sum(axis=1)


def vertex_normals(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Compute outward unit normals at the vertices: face normals averaged by area.

    Args:
        vertices: (B, V, 3) or (V, 3) m.
        faces: (F, 3) int64, counter-clockwise from outside.

    Returns:
        Normals of the vertices' shape. A vertex without a face of any area gets (0, 0, 1) and
        no gradient.
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
    """Scale vectors to length one; a zero vector becomes the fallback, with zero gradient.

    Args:
        vectors: (..., 3).
        fallback: broadcastable to `vectors`.
    """
    squared = (vectors * vectors).sum(dim=-1, keepdim=True)
    usable = squared > _TINY
    length = torch.where(usable, squared, torch.ones_like(squared)).sqrt()
    return torch.where(usable, vectors / length, fallback)


def to_trimesh(vertices: torch.Tensor | np.ndarray, faces: Any) -> trimesh.Trimesh:
    """Make a trimesh mesh; the vertices are kept as they are (no merging).

    Args:
        vertices: (V, 3) m.
        faces: (F, 3).
    """
    import trimesh

    if isinstance(vertices, torch.Tensor):
        vertices = vertices.detach().cpu().numpy()
    return trimesh.Trimesh(np.asarray(vertices), np.asarray(faces), process=False)


def _square_to_triangle(square: np.ndarray) -> np.ndarray:
    x, y = square.T
    upper = y > x
    first = np.where(upper, 0.5 * x, x - 0.5 * y)
    second = np.where(upper, y - 0.5 * x, 0.5 * y)
    return np.stack([first, second, 1.0 - first - second], axis=1)


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
