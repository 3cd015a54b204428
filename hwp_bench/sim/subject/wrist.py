"""The wrist of a rig: where its mesh ends, so that the sleeve begins there.

A hand model is open at the wrist. Rigs are closed there, go on as a forearm, or have other
holes, at nails for instance. The wrist is found from the joints: an outline is the wrist's if it
runs around the arm and lies near the wrist's joint. Where there is none, a plane across the arm
cuts the mesh as far behind the joint as the free hand ends. All other holes are closed.
"""

from __future__ import annotations

import numpy as np

from hwp_bench.base.errors import BadHandModel
from hwp_bench.base.numerics import kd_tree
from hwp_bench.sim.subject.rig_mesh import RigMesh, closed, components, cut, kept, outlines

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

    Args:
        mesh: a rig in the hand model's rest frame.
        joints: (16, 3) m.
        forward: (3,) unit vector from the wrist to the fingers.
        where: the file, for messages.

    Returns:
        The mesh; its only outline is the wrist's, whose middle lies at most `FARTHEST_BEHIND`
        behind and `FARTHEST_BEFORE` before the wrist's joint.

    Raises:
        BadHandModel: no place near the wrist's joint has skin all around it.
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

    Args:
        mesh: the mesh.
        behind: (V,) m, how far each vertex lies behind the joint.
        forward: (3,) unit vector.
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
