"""A rig's mesh, open at the wrist only, so that the sleeve begins there.

A hand model is open at the wrist. Rigs are closed there, go on as a forearm, or have other
holes, at nails for instance. The wrist is found from the joints: an outline is the wrist's if it
runs around the arm and lies near the wrist's joint. Where there is none, a plane across the arm
cuts the mesh as far behind the joint as the free hand ends. All other holes are closed. Weights
and texture seams follow every cut.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.base.errors import BadHandModel
from hwp_bench.base.numerics import kd_tree

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

    Takes `faces` (F,) bool.
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

    Takes `height` (V,) m.
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
    """Close holes, each with a fan from its middle."""
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


#: How far behind the wrist's joint a mesh is cut, m; the free hand's own rim lies there.
CUT_BEHIND = 0.010
#: Middle of an outline that is taken for the wrist's: so far behind and before the joint, m.
FARTHEST_BEHIND, FARTHEST_BEFORE = 0.025, 0.025
#: Longest extent of such an outline along the arm, m.
LONGEST = 0.03
# Step between planes that are tried, m.
_STEP = 0.002
# Skin that faces the elbow this much, as a cosine, closes a wrist; a cut through it is tried
# again farther on while it is more than this share of the cut's length.
_FACES_BACK, _SHARE = 0.6, 0.15
# A piece of a mesh farther from every joint of the hand than this, m, is not the hand's.
_FAR = 0.06
# Least way around the joint that an outline takes, of one round.
_AROUND = 0.6


def opened_at_wrist(mesh: RigMesh, joints: np.ndarray, forward: np.ndarray, where: str) -> RigMesh:
    """Make a mesh that is open at the wrist and nowhere else.

    Takes `joints` (16, 3) m, `forward` (3,) unit vector from the wrist to the fingers. Returns the
    mesh; its only outline is the wrist's, whose middle lies at most `FARTHEST_BEHIND` behind and
    `FARTHEST_BEFORE` before the wrist's joint.
    """
    mesh = _of_the_hand(mesh, joints, where)
    rim = _wrist_outline(mesh, joints[0], forward)
    if rim is None:
        behind = (joints[0] - mesh.vertices) @ forward
        if float(behind.max()) < -FARTHEST_BEFORE:
            raise BadHandModel(
                f"the mesh ends {-1000 * float(behind.max()):.0f} mm before its wrist joint",
                where=where,
                remedy="Move the joint to where the hand begins.",
            )
        mesh = _of_the_hand(cut(mesh, _plane(mesh, behind, forward) - behind), joints, where)
        rim = _wrist_outline(mesh, joints[0], forward)
    if rim is None:
        raise BadHandModel(
            "has no outline around its wrist joint, where a sleeve could begin",
            where=where,
            remedy="Put the wrist joint inside the skin, or close the skin around it.",
        )
    mesh = _without_what_hangs_behind(mesh, rim, joints[0], forward)
    rim = _wrist_outline(mesh, joints[0], forward)
    assert rim is not None
    wrist = set(rim.tolist())
    return closed(mesh, [loop for loop in outlines(mesh.faces) if set(loop.tolist()) != wrist])


def _of_the_hand(mesh: RigMesh, joints: np.ndarray, where: str) -> RigMesh:
    """Without pieces that are far from all joints, and without what no triangle uses."""
    piece = components(mesh.faces, len(mesh.vertices))
    distance, _ = kd_tree(joints).query(mesh.vertices)
    nearest = np.full(piece.max(initial=0) + 1, np.inf)
    np.minimum.at(nearest, piece, distance)
    near = nearest[piece[mesh.faces[:, 0]]] < _FAR
    if not near.any():
        raise BadHandModel("has no skin near the hand's joints", where=where)
    return kept(mesh, near)


def _plane(mesh: RigMesh, behind: np.ndarray, forward: np.ndarray) -> float:
    """How far behind the wrist's joint to cut, m: through skin around the arm, not its cap.

    Takes `behind` (V,) m, `forward` (3,) unit vector.
    """
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    back = -normal @ forward > _FACES_BACK * np.linalg.norm(normal, axis=1)
    low, high = behind[mesh.faces].min(axis=1), behind[mesh.faces].max(axis=1)
    size = np.sqrt(np.linalg.norm(normal, axis=1))
    best, least = CUT_BEHIND, np.inf
    for place in np.arange(CUT_BEHIND, -FARTHEST_BEFORE, -_STEP):
        crossed = (low < place) & (high > place)
        length = float(size[crossed].sum())
        share = float(size[crossed & back].sum()) / length if length > 0 else np.inf
        if share < least - _SHARE:
            best, least = float(place), share
    return best


def _wrist_outline(mesh: RigMesh, wrist: np.ndarray, forward: np.ndarray) -> np.ndarray | None:
    """The longest outline around the arm near the wrist's joint, or None."""
    best, longest = None, 0.0
    for loop in outlines(mesh.faces):
        offset = mesh.vertices[loop] - wrist
        along = offset @ forward
        near = -FARTHEST_BEHIND <= along.mean() <= FARTHEST_BEFORE and np.ptp(along) <= LONGEST
        if near and abs(_rounds(offset, forward)) >= _AROUND:
            length = float(np.linalg.norm(offset - np.roll(offset, 1, axis=0), axis=1).sum())
            if length > longest:
                best, longest = loop, length
    return best


def _rounds(offset: np.ndarray, forward: np.ndarray) -> float:
    """How often a loop runs around an axis through the origin: about 1, 0 or -1."""
    side = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angle = np.arctan2(offset @ np.cross(forward, side), offset @ side)
    turn = np.roll(angle, -1) - angle
    return float(((turn + np.pi) % (2.0 * np.pi) - np.pi).sum() / (2.0 * np.pi))


def _without_what_hangs_behind(
    mesh: RigMesh, rim: np.ndarray, wrist: np.ndarray, forward: np.ndarray
) -> RigMesh:
    """Without other pieces that lie behind the rim, such as a forearm of its own."""
    piece = components(mesh.faces, len(mesh.vertices))
    along = (mesh.vertices - wrist) @ forward
    ahead = np.full(piece.max() + 1, -np.inf)
    np.maximum.at(ahead, piece, along)
    stays = (ahead > along[rim].max()) | (np.arange(len(ahead)) == piece[rim[0]])
    return kept(mesh, stays[piece[mesh.faces[:, 0]]])
