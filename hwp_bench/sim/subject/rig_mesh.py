"""A rig's mesh: keep triangles, cut by a plane, close holes; weights and seams follow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Vertices nearer to a plane than this, m, count as on it, so that a cut leaves no slivers.
_ON_PLANE = 0.0003


@dataclass(frozen=True, eq=False)
class RigMesh:
    """A triangle mesh with the hand model's skinning weights."""

    #: (V, 3) m.
    vertices: np.ndarray
    #: (V, 16).
    weights: np.ndarray
    #: (F, 3).
    faces: np.ndarray
    #: (T, 2) texture coordinates.
    uv: np.ndarray
    #: (F, 3) indices into `uv`.
    face_uv: np.ndarray


def kept(mesh: RigMesh, faces: np.ndarray) -> RigMesh:
    """Some of a mesh's triangles, with the vertices that they use.

    Args:
        mesh: the mesh.
        faces: (F,) bool.
    """
    used, corner = np.unique(mesh.faces[faces], return_inverse=True)
    used_uv, corner_uv = np.unique(mesh.face_uv[faces], return_inverse=True)
    return RigMesh(
        mesh.vertices[used],
        mesh.weights[used],
        corner.reshape(-1, 3),
        mesh.uv[used_uv],
        corner_uv.reshape(-1, 3),
    )


def components(faces: np.ndarray, count: int) -> np.ndarray:
    """Number of the connected piece of each vertex: (V,)."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    edges = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = csr_matrix((np.ones(len(edges)), tuple(edges.T)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def cut(mesh: RigMesh, height: np.ndarray) -> RigMesh:
    """The part of a mesh where a height is positive; triangles across zero are split.

    Args:
        mesh: the mesh.
        height: (V,) m, signed distance of the vertices from a plane.
    """
    height = np.where(np.abs(height) < _ON_PLANE, 0.0, height)
    sign = np.sign(height[mesh.faces])
    whole = (sign >= 0).all(axis=1) & (sign > 0).any(axis=1)
    crossed = np.flatnonzero((sign > 0).any(axis=1) & (sign < 0).any(axis=1))
    places = _Splits(mesh.faces, height, len(mesh.vertices))
    seams = _Splits(mesh.face_uv, height, len(mesh.uv), mesh.faces)
    faces, face_uv = [mesh.faces[whole]], [mesh.face_uv[whole]]
    for face in crossed.tolist():
        ring, ring_uv = [], []
        for corner in range(3):
            after = (corner + 1) % 3
            if sign[face, corner] >= 0:
                ring.append(int(mesh.faces[face, corner]))
                ring_uv.append(int(mesh.face_uv[face, corner]))
            if sign[face, corner] * sign[face, after] < 0:
                ring.append(places.between(face, corner, after))
                ring_uv.append(seams.between(face, corner, after))
        for step in range(1, len(ring) - 1):
            faces.append(np.array([[ring[0], ring[step], ring[step + 1]]]))
            face_uv.append(np.array([[ring_uv[0], ring_uv[step], ring_uv[step + 1]]]))
    whole_mesh = RigMesh(
        places.spread(mesh.vertices),
        places.spread(mesh.weights),
        np.concatenate(faces),
        seams.spread(mesh.uv),
        np.concatenate(face_uv),
    )
    return kept(whole_mesh, np.ones(len(whole_mesh.faces), dtype=bool))


class _Splits:
    """New points on edges that cross zero, each made once."""

    def __init__(
        self, faces: np.ndarray, height: np.ndarray, count: int, owners: np.ndarray | None = None
    ) -> None:
        self._faces = faces
        self._heights = height[faces if owners is None else owners]
        self._count = count
        self._made: dict[tuple[int, int], int] = {}
        self._shares: list[float] = []

    def between(self, face: int, corner: int, after: int) -> int:
        """Index of the point on an edge of a face."""
        one, other = int(self._faces[face, corner]), int(self._faces[face, after])
        low, high = self._heights[face, corner], self._heights[face, after]
        if one > other:
            one, other, low, high = other, one, high, low
        if (one, other) not in self._made:
            self._made[one, other] = self._count + len(self._made)
            self._shares.append(float(low / (low - high)))
        return self._made[one, other]

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Values of the old and the new points."""
        if not self._made:
            return values
        ends = np.array(list(self._made))
        share = np.array(self._shares)[:, None]
        return np.concatenate(
            [values, (1.0 - share) * values[ends[:, 0]] + share * values[ends[:, 1]]]
        )


def outlines(faces: np.ndarray) -> list[np.ndarray]:
    """The closed loops of edges that have one triangle only, each in order.

    Where loops touch in a vertex, each is followed until it comes back to where it was.
    """
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, inverse, counts = np.unique(
        np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    onward: dict[int, list[int]] = {}
    for start, end in edges[counts[inverse.reshape(-1)] == 1].tolist():
        onward.setdefault(start, []).append(end)
    loops = []
    while onward:
        path = [next(iter(onward))]
        place = {path[0]: 0}
        while path:
            ends = onward.get(path[-1])
            if ends is None:
                del place[path.pop()]
                continue
            step = ends.pop()
            if not ends:
                del onward[path[-1]]
            if step in place:
                loop = path[place[step] :]
                loops.append(np.array(loop, dtype=np.int64))
                for vertex in loop[1:]:
                    del place[vertex]
                del path[place[step] + 1 :]
            else:
                place[step] = len(path)
                path.append(step)
    return [loop for loop in loops if len(loop) >= 3]


def closed(mesh: RigMesh, loops: list[np.ndarray]) -> RigMesh:
    """Close holes, each with a fan from its middle.

    Args:
        mesh: the mesh.
        loops: outlines of the holes, as `outlines` gives them.
    """
    if not loops:
        return mesh
    place_of: dict[int, int] = {}
    for face, corner in np.argwhere(np.isin(mesh.faces, np.concatenate(loops))):
        place_of.setdefault(int(mesh.faces[face, corner]), int(mesh.face_uv[face, corner]))
    vertices, weights, uv = [mesh.vertices], [mesh.weights], [mesh.uv]
    faces, face_uv = [mesh.faces], [mesh.face_uv]
    for number, loop in enumerate(loops):
        spots = np.array([place_of[int(vertex)] for vertex in loop])
        vertices.append(mesh.vertices[loop].mean(axis=0, keepdims=True))
        weights.append(mesh.weights[loop].mean(axis=0, keepdims=True))
        uv.append(mesh.uv[spots].mean(axis=0, keepdims=True))
        # The hole's edges run along its triangles, so the fan's run against them.
        for rows, middle, parts in (
            (loop, len(mesh.vertices) + number, faces),
            (spots, len(mesh.uv) + number, face_uv),
        ):
            fan = [np.roll(rows, -1), rows, np.full(len(rows), middle)]
            parts.append(np.stack(fan, axis=1))
    return RigMesh(*(np.concatenate(part) for part in (vertices, weights, faces, uv, face_uv)))
