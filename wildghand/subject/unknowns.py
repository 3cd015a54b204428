"""The numbers that describe a person's hand, and how an outline in the image moves with each.

In one vector, in this order: displacements of control points, displacements of joints, proportions,
and a translation of each hand in each frame. A posed hand is linear in its rest surface and rest
joints, so that every point of an outline is linear in all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from hwp_bench.hands import HandTemplate, unique_edges
from hwp_bench.hands.skeleton import (
    FINGERS,
    JOINT_COUNT,
    PARENTS,
    finger_joints,
    moved_joints,
    palm_directions,
)
from wildghand.subject.outlines import ComparedFrames, OutlinePoints, PosedFrames
from wildghand.subject.shape import SubjectShape, side_flip

#: Control points on the hand, about a centimetre apart.
NODES = 200
#: Expected change of the length of a bone, or of a side of the palm, and of the thickness of a
#: finger's segment, relative to the template: about how people differ.
LENGTH_SPREAD, THICKNESS_SPREAD = 0.1, 0.15
# Expected displacement of a control point, and difference between control points 1 cm apart, m.
_SPREAD, _ROUGHNESS = 4e-3, 1e-3
# Expected distance of a joint from where its surroundings take it, and error of the given
# translation of a hand in a frame, m.
_JOINT_SPREAD, _TRANSL_SPREAD = 2e-3, 2e-3


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """K points on the surface, and how they move V vertices."""

    #: (V, K) shares of each vertex; rows sum to 1.
    shares: np.ndarray
    #: (E, 2) pairs of neighbouring points.
    pairs: np.ndarray
    #: (E,) m along the surface between them.
    lengths: np.ndarray


def place_control_points(template: HandTemplate, count: int) -> ControlPoints:
    """Spread control points over a hand, each as far as possible from those before it.

    Distances run along the edges of the mesh, so that neighbouring fingers move apart.
    """
    vertices, edges = template.vertices, unique_edges(template.faces)[0]
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    graph = coo_matrix((lengths, edges.T), shape=(len(vertices),) * 2).tocsr()
    count = min(count, len(vertices))
    chosen = [0]
    paths = [dijkstra(graph, directed=False, indices=0)]
    nearest = paths[0].copy()
    for _ in range(count - 1):
        chosen.append(int(np.where(np.isfinite(nearest), nearest, -1.0).argmax()))
        paths.append(dijkstra(graph, directed=False, indices=chosen[-1], limit=0.08))
        nearest = np.minimum(nearest, paths[-1])
    distance = np.stack(paths, axis=1)
    width = float(np.median(np.sort(distance[chosen], axis=1)[:, min(1, count - 1)]))
    shares = np.exp(-0.5 * (distance / max(width, 1e-6)) ** 2)
    shares[np.arange(len(vertices)), distance.argmin(axis=1)] += 1e-6  # far from all of them
    shares /= shares.sum(axis=1, keepdims=True)
    between = distance[chosen]
    first, second = np.nonzero(np.triu(between < 2.0 * width, k=1))
    return ControlPoints(shares, np.column_stack([first, second]), between[first, second])


@dataclass(frozen=True, eq=False)
class Proportions:
    """S numbers, each a change relative to the template's, and how they move its right hand.

    They are the lengths of the 15 bones of the fingers, the thicknesses of their 15 segments, and
    length, width and thickness of the palm.
    """

    #: (V, 3, S) m that each rest vertex moves for a change by all of itself.
    vertices: np.ndarray
    #: (16, 3, S) m that each rest joint moves.
    joints: np.ndarray
    #: (S,) bool: the number is a length of a bone or of the palm, and no thickness.
    lengths: np.ndarray


def hand_proportions(template: HandTemplate) -> Proportions:
    """The proportions of a template."""
    moves: list[tuple[np.ndarray, np.ndarray, bool]] = []
    below = moved_joints()
    for finger, name in enumerate(FINGERS):
        chain = finger_joints(name)
        ends = [*template.joints[list(chain)], template.vertices[template.fingertips[finger]]]
        for step, joint in enumerate(chain):
            bone = ends[step + 1] - ends[step]
            along = (template.vertices - ends[step]) @ bone / (bone @ bone)
            # Skin around a bone is stretched with it, and what is beyond it moves on with its end.
            carried = template.weights @ below[joint] * np.clip(along, 0.0, 1.0)
            after = below[joint].copy()
            after[joint] = 0.0
            moves.append((carried[:, None] * bone, after[:, None] * bone, True))
            aside = template.vertices - ends[step] - along[:, None] * bone
            own = template.weights[:, joint, None]
            moves.append((own * aside, np.zeros((JOINT_COUNT, 3)), False))
    wrist = template.joints[0]
    directions = palm_directions(template.joints, template.side)
    for axis in (directions.forward, directions.thumbward, directions.palmar):
        # The palm is scaled about the wrist; a finger goes where its first joint goes.
        joints = np.outer((template.joints - wrist) @ axis, axis)
        for name in FINGERS:
            first, *others = finger_joints(name)
            joints[others] = joints[first]
        surface = template.weights[:, :1] * np.outer((template.vertices - wrist) @ axis, axis)
        moves.append((surface + template.weights[:, 1:] @ joints[1:], joints, True))
    flip = side_flip(template.side)[:, None]
    return Proportions(
        vertices=np.stack([move[0] for move in moves], axis=-1) * flip,
        joints=np.stack([move[1] for move in moves], axis=-1) * flip,
        lengths=np.array([move[2] for move in moves]),
    )


@dataclass(frozen=True, eq=False)
class Unknowns:
    """The numbers that are sought of a person whose hands are seen in some frames."""

    #: On the rest hand.
    points: ControlPoints
    #: Of the rest hand.
    proportions: Proportions
    #: (16, V) shares of the vertices around each joint.
    surroundings: np.ndarray
    #: S, of the hands.
    hands: int
    #: F, of the frames.
    frames: int

    @classmethod
    def of(cls, template: HandTemplate, hands: int, frames: int) -> Unknowns:
        """The unknowns of a person whose hands, one or two, are compared in some frames."""
        return cls(
            place_control_points(template, NODES),
            hand_proportions(template),
            _joint_surroundings(template),
            hands,
            frames,
        )

    @property
    def cuts(self) -> tuple[int, int, int]:
        """Where the control points, the joints and the proportions end."""
        nodes = 3 * self.points.shares.shape[1]
        joints = nodes + 3 * JOINT_COUNT
        return nodes, joints, joints + len(self.proportions.lengths)

    def __len__(self) -> int:
        return self.cuts[2] + 3 * self.hands * self.frames

    def shape(self, values: np.ndarray) -> SubjectShape:
        """The person's hand."""
        nodes, joints, proportions, _ = np.split(values, self.cuts)
        return SubjectShape(
            self.points.shares @ nodes.reshape(-1, 3) + self.proportions.vertices @ proportions,
            joints.reshape(-1, 3) + self.proportions.joints @ proportions,
        )

    def moves(self, values: np.ndarray) -> np.ndarray:
        """(S, F, 3) m, added to the given translations of the hands."""
        return values[self.cuts[2] :].reshape(self.hands, self.frames, 3)

    def expected(self) -> np.ndarray:
        """(N, N) inverse covariance of the unknowns before anything is seen."""
        points, size, (cut, end, proportions) = self.points, len(self), self.cuts
        count = points.shares.shape[1]
        result = np.zeros((size, size))
        diagonal = np.full(size, 1.0 / _TRANSL_SPREAD**2)
        diagonal[:cut] = 1.0 / _SPREAD**2
        diagonal[cut:end] = 0.0
        spreads = np.where(self.proportions.lengths, LENGTH_SPREAD, THICKNESS_SPREAD)
        diagonal[end:proportions] = 1.0 / spreads**2
        result[np.arange(size), np.arange(size)] = diagonal
        first, second = points.pairs.T
        rough = 0.01 / (points.lengths * _ROUGHNESS**2)
        together = np.zeros((count + JOINT_COUNT,) * 2)
        np.add.at(together, (first, first), rough)
        np.add.at(together, (second, second), rough)
        np.add.at(together, (first, second), -rough)
        np.add.at(together, (second, first), -rough)
        # Joints go where the surface around them goes.
        around = self.surroundings @ points.shares
        tie = np.concatenate([around, -np.eye(JOINT_COUNT)], axis=1)
        together += tie.T @ tie / _JOINT_SPREAD**2
        together[count, count] += 1e12  # the wrist
        result[:end, :end] += np.kron(together, np.eye(3))
        return result


def _joint_surroundings(template: HandTemplate) -> np.ndarray:
    """(16, V) shares of the vertices around each joint, rows sum to 1: where two segments meet."""
    shares = np.zeros((JOINT_COUNT, len(template.vertices)))
    for joint, parent in enumerate(PARENTS):
        weights = template.weights[:, joint]
        meeting = weights * template.weights[:, parent] if parent >= 0 else weights
        distance = np.linalg.norm(template.vertices - template.joints[joint], axis=1)
        shares[joint] = (meeting + 1e-6) * np.exp(-0.5 * (distance / 0.01) ** 2)
    normed: np.ndarray = shares / shares.sum(axis=1, keepdims=True)
    return normed


def vertex_turns(turns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """How a displacement of a rest vertex moves the posed one.

    Args:
        turns: (16, 3, 3) rotation of each joint's segment, rest to posed.
        weights: (V, 16) skinning weights.

    Returns:
        (V, 3, 3).
    """
    blended: np.ndarray = (weights @ turns.reshape(JOINT_COUNT, 9)).reshape(-1, 3, 3)
    return blended


def joint_turns(turns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """How displacements of the rest joints move posed vertices; the wrist stays where it is.

    A vertex is sum_k w_k (G_k (v - j_k) + p_k), and the posed joint is p_k = p_parent +
    G_parent (j_k - j_parent): both are linear in the rest joints j.

    Args:
        turns: (16, 3, 3) rotation of each joint's segment, rest to posed.
        weights: (V, 16) skinning weights.

    Returns:
        (V, 16, 3, 3): of vertex v by rest joint j.
    """
    places = np.zeros((JOINT_COUNT, JOINT_COUNT, 3, 3))  # of posed joint k by rest joint j
    for joint, parent in enumerate(PARENTS):
        if parent < 0:
            continue
        places[joint] = places[parent]
        places[joint, joint] += turns[parent]
        places[joint, parent] -= turns[parent]
    moved = places.copy()
    moved[np.arange(JOINT_COUNT), np.arange(JOINT_COUNT)] -= turns
    moved[:, 0] = 0.0
    flat: np.ndarray = weights @ moved.reshape(JOINT_COUNT, -1)
    return flat.reshape(-1, JOINT_COUNT, 3, 3)


def outline_rows(
    unknowns: Unknowns,
    frames: ComparedFrames,
    posed: PosedFrames,
    frame: int,
    seen: OutlinePoints,
) -> np.ndarray:
    """Rows of the linear problem of one frame.

    Returns:
        (M, N) float32, px along the outward direction of each point for a unit of each unknown.
    """
    at = frames.faces[seen.face]
    slope = _slopes(frames, posed, frame, seen, at)
    result = np.zeros((len(at), len(unknowns)), dtype=np.float32)
    nodes, joints, proportions = unknowns.cuts
    for index, (side, template) in enumerate(frames.templates.items()):
        mine = np.flatnonzero(at[:, 0] // frames.count == index)
        if not len(mine):
            continue
        count, flip, turns = len(mine), side_flip(side), posed.turns[index][frame]
        corner, mix = at[mine] - index * frames.count, seen.mix[mine]
        used, where = np.unique(corner, return_inverse=True)
        where = where.reshape(corner.shape)
        # Of the rest vertices at the three corners of each point's face, (M, 3, 3).
        moved = vertex_turns(turns, template.weights[used])[where]
        of_corners = mix[..., None] * (slope[mine, None, None] @ moved)[:, :, 0] * flip
        # Of the rest joints, (M, 48).
        bones = joint_turns(turns, template.weights[used]).reshape(len(used), -1)
        bones = np.einsum("mc,mcx->mx", mix, bones[where]).reshape(count, JOINT_COUNT, 3, 3)
        of_joints = (np.einsum("mi,mjik->mjk", slope[mine], bones) * flip).reshape(count, -1)

        shares = unknowns.points.shares[used][where].transpose(0, 2, 1)
        result[mine, :nodes] = (shares @ of_corners).reshape(count, -1)
        result[mine, nodes:joints] = of_joints
        stretched = unknowns.proportions.vertices[used][where].reshape(count, 9, -1)
        carried = unknowns.proportions.joints.reshape(3 * JOINT_COUNT, -1)
        result[mine, joints:proportions] = (
            np.einsum("mx,mxs->ms", of_corners.reshape(count, 9), stretched) + of_joints @ carried
        )
        start = proportions + 3 * (index * len(frames) + frame)
        result[mine, start : start + 3] = slope[mine]
    return result


def _slopes(
    frames: ComparedFrames, posed: PosedFrames, frame: int, seen: OutlinePoints, at: np.ndarray
) -> np.ndarray:
    """(M, 3) px along the outward direction for each metre that a posed point moves."""
    viewmat, K = frames.viewmats[frame], frames.Ks[frame]
    place = np.einsum("mc,mck->mk", seen.mix, posed.meshes[frame][at])
    camera = place @ viewmat[:3, :3].T + viewmat[:3, 3]
    away = camera[:, 2:]
    focal = seen.outward * [K[0, 0], K[1, 1]]
    along = -(focal * camera[:, :2]).sum(axis=1, keepdims=True) / away**2
    slope: np.ndarray = np.concatenate([focal / away, along], axis=1) @ viewmat[:3, :3]
    return slope
