"""How deep skin lies inside other skin: of the same hand, or of one hand in the other.

A hand is cut into the segments that its 16 joints move, each closed with caps. A vertex lies
inside a segment where the segment's winding number exceeds one half; its depth is its distance
to the segment's skin. Neighbours are left out, as skin folds there: the segment that a vertex
belongs to, the segments that touch that one, and skin nearer than `NEAR` along the surface.

Source: solid angles after Van Oosterom and Strackee, "The solid angle of a plane triangle"
(1983); inside by winding number after Jacobson et al., "Robust inside-outside segmentation using
generalized winding numbers" (2013).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hwp_bench.hands import HandTemplate
from hwp_bench.hands.skeleton import JOINT_COUNT
from hwp_bench.sim.effects import hands_at
from hwp_bench.sim.scene.scene import HandMoment, Scene, hand_parameters, scene_hands
from hwp_bench.sim.subject.hand import MOVING, SubjectHand

#: Way along the skin, m, below which two places of a hand are neighbours.
NEAR = 0.02


@dataclass(frozen=True, eq=False)
class Segments:
    """A hand's template, cut into closed segments."""

    #: (T,) segment of each vertex: the joint that moves it most.
    owner: np.ndarray
    #: Skin of each segment, (F, 3) vertices of the template.
    skin: tuple[np.ndarray, ...]
    #: Loops where each segment was cut, each (E, 2) directed edges of its skin.
    cuts: tuple[tuple[np.ndarray, ...], ...]
    #: (16, 16) whether two segments are the same or share an edge.
    touching: np.ndarray
    #: (T, T) way along the skin of the rest hand, m.
    way: np.ndarray


@lru_cache(maxsize=4)
def segments(template: HandTemplate) -> Segments:
    """Cut a template into segments."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    owner = np.argmax(template.weights, axis=1)
    faces = template.faces
    of_face = np.argmax(template.weights[faces].sum(axis=1), axis=1)
    touching = np.eye(JOINT_COUNT, dtype=bool)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        touching[owner[faces[:, a]], owner[faces[:, b]]] = True
    skin = tuple(faces[of_face == joint] for joint in range(JOINT_COUNT))
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    length = np.linalg.norm(np.diff(template.vertices[edges], axis=1)[:, 0], axis=1)
    count = len(template.vertices)
    graph = csr_matrix((length, tuple(edges.T)), shape=(count, count))
    return Segments(
        owner=owner,
        skin=skin,
        cuts=tuple(_cuts(part, count) for part in skin),
        touching=touching | touching.T,
        way=dijkstra(graph, directed=False),
    )


def self_penetration(parts: Segments, vertices: np.ndarray) -> np.ndarray:
    """Depth of every vertex inside segments of its own hand that are not neighbours.

    Args:
        parts: the hand.
        vertices: (T, 3) m, posed.

    Returns:
        (T,) m; 0 outside.
    """
    depth = np.zeros(len(vertices))
    for joint, skin in enumerate(parts.skin):
        others = np.flatnonzero(~parts.touching[joint, parts.owner])
        found, corner, inside = _depth(vertices[others], vertices, skin, parts.cuts[joint])
        far = parts.way[others[inside], corner] >= NEAR
        reached = others[inside][far]
        depth[reached] = np.maximum(depth[reached], found[far])
    return depth


def mutual_penetration(points: np.ndarray, parts: Segments, vertices: np.ndarray) -> np.ndarray:
    """Depth of points inside a hand.

    Args:
        points: (N, 3) m, such as the vertices of the other hand.
        parts: the hand.
        vertices: (T, 3) m, posed.

    Returns:
        (N,) m; 0 outside.
    """
    depth = np.zeros(len(points))
    for skin, cuts in zip(parts.skin, parts.cuts, strict=True):
        found, _, inside = _depth(points, vertices, skin, cuts)
        depth[inside] = np.maximum(depth[inside], found)
    return depth


def hand_penetration(hand: SubjectHand, moment: HandMoment, side: str) -> np.ndarray:
    """Depth of every template vertex of one hand inside that hand: (T,) m."""
    return self_penetration(segments(hand.template), _posed(hand, moment, side))


def scene_penetration(scene: Scene, moments: Iterable[float]) -> dict[str, np.ndarray]:
    """Deepest place of sampled frames, on the surface that is rendered.

    Args:
        scene: the scene, with its effects on the pose.
        moments: fractions of the capture.

    Returns:
        By side the hand inside itself, and for two hands `both`, one inside the other: one
        depth for each moment, m.
    """
    subjects = scene_hands(scene, MOVING)
    rows: dict[str, list[float]] = {}
    for moment in moments:
        hands = hands_at(scene, moment * scene.duration)
        posed = {side: _posed(subjects[side], hands[side], side) for side in scene.sides}
        parts = {side: segments(subjects[side].template) for side in scene.sides}
        for side in scene.sides:
            deepest = self_penetration(parts[side], posed[side]).max()
            rows.setdefault(side, []).append(float(deepest))
        if len(scene.sides) == 2:
            right, left = (posed[side] for side in ("right", "left"))
            either = (
                mutual_penetration(right, parts["left"], left).max(),
                mutual_penetration(left, parts["right"], right).max(),
            )
            rows.setdefault("both", []).append(float(max(either)))
    return {name: np.array(values) for name, values in rows.items()}


def _posed(hand: SubjectHand, moment: HandMoment, side: str) -> np.ndarray:
    """The rendered surface at the template's vertices: (T, 3) m."""
    vertices, _ = hand.pose(*hand_parameters(moment, side, hand.joints))
    return vertices[: len(hand.template.vertices)]


def _cuts(skin: np.ndarray, count: int) -> tuple[np.ndarray, ...]:
    """The boundary of some faces, as connected sets of directed edges."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    edges = skin[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    there = {(int(a), int(b)) for a, b in edges}
    rim = np.array([edge for edge in sorted(there) if edge[::-1] not in there], dtype=np.int64)
    if not len(rim):
        return ()
    graph = csr_matrix((np.ones(len(rim)), tuple(rim.T)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    return tuple(rim[label[rim[:, 0]] == loop] for loop in np.unique(label[rim[:, 0]]))


def _depth(
    points: np.ndarray, vertices: np.ndarray, skin: np.ndarray, cuts: tuple[np.ndarray, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth, nearest vertex of the skin, and index of the points that lie inside: (P,) each."""
    from trimesh.triangles import closest_point

    if not len(skin):
        # With wide folds a joint may move no triangle most.
        nothing = np.zeros(0, dtype=np.int64)
        return np.zeros(0), nothing, nothing
    triangles = vertices[skin]
    box = triangles.reshape(-1, 3)
    near = np.flatnonzero(((points > box.min(axis=0)) & (points < box.max(axis=0))).all(axis=1))
    caps = [
        np.stack(
            [vertices[rim[:, 1]], vertices[rim[:, 0]], np.broadcast_to(middle, (len(rim), 3))], 1
        )
        for rim in cuts
        for middle in (vertices[rim[:, 0]].mean(axis=0),)
    ]
    inside = near[_winding(points[near], np.concatenate([triangles, *caps])) > 0.5]
    pairs = np.repeat(points[inside], len(skin), axis=0)
    nearest = (
        closest_point(np.tile(triangles, (len(inside), 1, 1)), pairs) if len(inside) else pairs
    )
    distance = np.linalg.norm(nearest - pairs, axis=1).reshape(len(inside), len(skin))
    face = distance.argmin(axis=1)
    return distance[np.arange(len(inside)), face], skin[face, 0], inside


def _winding(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """How often a closed surface winds around each point: (N,)."""
    a, b, c = (triangles[None, :, corner] - points[:, None] for corner in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=2) for side in (a, b, c))
    volume = np.einsum("nfk,nfk->nf", a, np.cross(b, c))
    dots = [np.einsum("nfk,nfk->nf", one, other) for one, other in ((a, b), (b, c), (c, a))]
    below = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    return np.arctan2(volume, below).sum(axis=1) / (2.0 * np.pi)
