"""Rigged hands from glTF files, brought into the hand model's joints, size and rest frame.

The rig keeps its own mesh, skinning weights and texture. A left hand is made of a right one by
mirroring, and the other way round. Meshes of any topology are taken: rigs are closed at the wrist,
continue as a forearm or a whole body, or have holes elsewhere. The wrist is found from the joints:
an outline is the wrist's if it runs around the arm and lies near the wrist's joint. Where there is
none, a plane across the arm cuts the mesh as far behind the joint as the free hand ends. All other
holes are closed.

Joints are known by name. Two schemes are known word by word: WebXR
(`index-finger-phalanx-proximal`) and OpenXR as Godot writes it (`Index_Proximal_R`). Others are
read from the words in a name: a finger, and a part or a number, as in Mixamo
(`mixamorig:RightHandIndex1`), VRM and Unity (`rightIndexProximal`), SMPL-X and MANO
(`right_index1`), Unreal (`index_01_r`), Rigify (`DEF-f_index.01.R`), Oculus (`b_r_index1`) and
SteamVR (`finger_index_0_r`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import BadHandModel, UsageError
from hwp_bench.base.numerics import kd_tree
from hwp_bench.hands import HandTemplate, mirror_template
from hwp_bench.hands.skeleton import FINGERS, JOINT_COUNT, PARENTS, SHAPE_COUNT
from hwp_bench.hands.template import make_template
from hwp_bench.sim.geometry.surface import best_turn
from hwp_bench.sim.hand.gltf import SkinnedMesh, paintable, read_skinned_mesh

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
    """The triangles of a mesh that are asked for, (F,) bool, with the vertices that they use."""
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
    """The part of a mesh where a height (V,), m, is positive; triangles across zero are split."""
    height = np.where(np.abs(height) < _ON_PLANE, 0.0, height)
    sign = np.sign(height[mesh.faces])
    whole = (sign >= 0).all(axis=1) & (sign > 0).any(axis=1)
    crossed = (sign > 0).any(axis=1) & (sign < 0).any(axis=1)
    heights, sign = height[mesh.faces[crossed]], sign[crossed]
    faces, points = _split(mesh.faces[crossed], heights, sign, len(mesh.vertices))
    face_uv, seams = _split(mesh.face_uv[crossed], heights, sign, len(mesh.uv))
    whole_mesh = RigMesh(
        _spread(mesh.vertices, points),
        _spread(mesh.weights, points),
        np.concatenate([mesh.faces[whole], faces]),
        _spread(mesh.uv, seams),
        np.concatenate([mesh.face_uv[whole], face_uv]),
    )
    return kept(whole_mesh, np.ones(len(whole_mesh.faces), dtype=bool))


def _split(
    faces: np.ndarray, heights: np.ndarray, sign: np.ndarray, count: int
) -> tuple[np.ndarray, dict[tuple[int, int], float]]:
    """Cut faces at zero: the parts above, and the fractions of the edges where new points lie."""
    shares: dict[tuple[int, int], float] = {}
    index: dict[tuple[int, int], int] = {}
    parts: list[list[int]] = []
    for face, high, side in zip(faces.tolist(), heights.tolist(), sign.tolist(), strict=True):
        ring: list[int] = []
        for corner, after in ((0, 1), (1, 2), (2, 0)):
            if side[corner] >= 0:
                ring.append(face[corner])
            if side[corner] * side[after] < 0:
                (one, low), (other, top) = sorted(
                    [(face[corner], high[corner]), (face[after], high[after])]
                )
                shares.setdefault((one, other), low / (low - top))
                ring.append(index.setdefault((one, other), count + len(index)))
        parts += [[ring[0], *ring[step : step + 2]] for step in range(1, len(ring) - 1)]
    return np.array(parts, dtype=np.int64).reshape(-1, 3), shares


def _spread(values: np.ndarray, shares: dict[tuple[int, int], float]) -> np.ndarray:
    """Values of the old and the new points."""
    if not shares:
        return values
    ends, share = np.array(list(shares)), np.array(list(shares.values()))[:, None]
    between = (1.0 - share) * values[ends[:, 0]] + share * values[ends[:, 1]]
    return np.concatenate([values, between])


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

    The middle of the outline lies at most `FARTHEST_BEHIND` behind and `FARTHEST_BEFORE` before the
    wrist's joint; `forward` (3,) leads from there to the fingers.
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
    """How far behind the wrist's joint to cut, m: through skin around the arm, not its cap."""
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


_THREE = ("proximal", "intermediate", "distal")
#: Joints of the hand model, in its order, as WebXR names them.
WEBXR = (
    "wrist",
    *(f"{x}-finger-phalanx-{y}" for x in ("index", "middle", "pinky", "ring") for y in _THREE),
    *("thumb-metacarpal", "thumb-phalanx-proximal", "thumb-phalanx-distal"),
)
#: Words of a finger, in the hand model's order.
_FINGERS = {
    "index": ("index", "forefinger", "pointer"),
    "middle": ("middle", "mid"),
    "little": ("little", "pinky", "pinkie", "small"),
    "ring": ("ring",),
    "thumb": ("thumb",),
}
_SIDES = {"right": "right", "r": "right", "left": "left", "l": "left"}
_PARTS = ("metacarpal", "meta", "proximal", "intermediate", "medial", "distal")
# Words of joints beyond the last one, or of helpers.
_ASIDE = frozenset(
    (
        *("tip", "end", "nub", "aux", "null", "ik", "pole", "target", "ctrl", "twist", "roll"),
        "effector",
    )
)
# Words of the rest of a body.
_BODY = frozenset(
    (
        *("spine", "chest", "neck", "head", "jaw", "eye", "hip", "hips", "pelvis", "torso"),
        *("leg", "upleg", "thigh", "calf", "knee", "foot", "toe", "ankle"),
        *("breast", "shoulder", "clavicle", "upperarm"),
    )
)
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+")


def words(name: str) -> list[str]:
    """The words and numbers in a name, in small letters: `RightHandIndex1` has four."""
    return [word.lower() for word in _WORD.findall(name)]


def side_of_name(name: str) -> str | None:
    """`right` or `left` where a name says so."""
    found = {_SIDES[word] for word in words(name) if word in _SIDES}
    return found.pop() if len(found) == 1 else None


def hand_joints(names: list[str], wanted: str, where: str) -> tuple[list[int], str | None]:
    """Rows in `names` of the hand model's 16 joints, and the side that the names state, if any."""
    best: list[int | None] = [None] * len(WEBXR)
    told: str | None = None
    sides = {side_of_name(name) for name in names}
    for side in (wanted, None, "left" if wanted == "right" else "right"):
        found = _by_words(names, side) if side in sides else best
        if found.count(None) < best.count(None):
            best, told = found, side
    missing = [name for name, row in zip(WEBXR, best, strict=True) if row is None]
    if missing:
        raise BadHandModel(
            f"{len(missing)} joints are missing, the first is {missing[0]!r}",
            where=where,
            field="skins[0].joints",
            remedy="Names of WebXR, OpenXR, Mixamo, VRM, SMPL-X, Unreal and Rigify are understood.",
        )
    return [row for row in best if row is not None], told


def _by_words(names: list[str], side: str | None) -> list[int | None]:
    fingers: dict[str, dict[str, int]] = {finger: {} for finger in _FINGERS}
    wrists: list[tuple[bool, int, int]] = []
    for row, name in enumerate(names):
        said = words(name)
        if side_of_name(name) != side or _ASIDE & set(said):
            continue
        named = [finger for word in said for finger in _FINGERS if word in _FINGERS[finger]]
        if named:
            part = _part(said, named[0])
            if part is not None:
                fingers[named[0]].setdefault(part, row)
        elif "wrist" in said or "hand" in said:
            wrists.append(("wrist" not in said, len(said), row))
    found: list[int | None] = [min(wrists)[2] if wrists else None]
    for finger in _FINGERS:
        found += _three(fingers[finger], thumb=finger == "thumb")
    return found


def _part(said: list[str], finger: str) -> str | None:
    """The part that a joint's name says, or its number."""
    for word in reversed(said):
        if word in _PARTS and word not in _FINGERS[finger]:
            return word
        if word.isdigit():
            return str(int(word)) if len(word) < 4 else None
    return None


def _three(parts: dict[str, int], *, thumb: bool) -> list[int | None]:
    """The three joints of a finger from its parts, or None for those that are missing."""
    numbers = sorted(int(part) for part in parts if part.isdigit())
    if numbers:
        # A joint before the first three is a bone of the palm, one after them the tip.
        start = 1 if 1 in numbers and 3 in numbers else 0
        return [parts.get(str(start + step)) for step in range(3)]
    middle = "intermediate" if "intermediate" in parts else "medial"
    order = ("proximal", middle, "distal")
    if thumb and middle not in parts:
        order = ("metacarpal" if "metacarpal" in parts else "meta", "proximal", "distal")
    return [parts.get(part) for part in order]


# The last bone ends in skin, not in a joint; smaller differences of its direction are not sure.
_UNSURE = np.radians(6.0)


def into_rest_pose(
    mesh: RigMesh,
    joints: np.ndarray,
    tips: np.ndarray,
    target: np.ndarray,
    target_tips: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Turn every finger bone to where the hand model's points, by linear blend skinning.

    Returns (V, 3) vertices and (16, 3) joints, m; bones keep their lengths.
    """
    ends, target_ends = _bone_ends(joints, tips), _bone_ends(target, target_tips)
    turns = np.tile(np.eye(3), (JOINT_COUNT, 1, 1))
    places = joints.copy()
    for joint in range(1, JOINT_COUNT):
        parent = PARENTS[joint]
        places[joint] = places[parent] + turns[parent] @ (joints[joint] - joints[parent])
        bone = turns[parent] @ (ends[joint] - joints[joint])
        unsure = _UNSURE if joint in _LAST else 0.0
        turn = _shortest_turn(bone, target_ends[joint] - target[joint], unsure)
        turns[joint] = turn @ turns[parent]
    moved = np.zeros_like(mesh.vertices)
    for joint in range(JOINT_COUNT):
        there = (mesh.vertices - joints[joint]) @ turns[joint].T + places[joint]
        moved += mesh.weights[:, joint, None] * there
    return moved, places


def _bone_ends(joints: np.ndarray, tips: np.ndarray) -> np.ndarray:
    ends = np.vstack([joints[1:], joints[:1]])
    ends[list(_LAST)] = tips
    return ends


def _shortest_turn(start: np.ndarray, end: np.ndarray, unsure: float) -> np.ndarray:
    """Rotation between two directions: (3, 3); none below an angle in rad."""
    from scipy.spatial.transform import Rotation

    axis = np.cross(start, end)
    length = float(np.linalg.norm(axis))
    angle = float(np.arctan2(length, start @ end))
    if length < 1e-15 or angle <= unsure:
        return np.eye(3)
    return Rotation.from_rotvec(axis / length * (angle - unsure)).as_matrix()


#: Most triangles of a hand; images here are too small to show more.
MAX_HAND_FACES = 250_000
#: What a subject's `model` begins with: the path of a file follows, or the name of a rig that
#: comes with the package.
FROM_FILE, SHIPPED = "gltf:", "rig:"
_FOLDER = Path(__file__).with_name("rig_files")
# Joints of the palm, which the hand model does not have; the wrist takes their weights.
_FOLDED = ("metacarpal", "palm")
# Last joints of the fingers, in the order of `FINGERS`.
_LAST = (15, 3, 6, 12, 9)


def rig_path(model: str) -> str | None:
    """The file of a subject's rig, or None where `model` names no rig."""
    if model.startswith(FROM_FILE):
        return model.removeprefix(FROM_FILE)
    if not model.startswith(SHIPPED):
        return None
    known = {path.stem: str(path) for path in sorted(_FOLDER.glob("*.glb"))}
    name = model.removeprefix(SHIPPED)
    if name not in known:
        raise UsageError(
            f"there is no rig {name!r}",
            field="model",
            remedy=f"Known: {', '.join(known)}; or gltf: and the path of a file.",
        )
    return known[name]


def load_rig(path: str, side: str, model: HandTemplate) -> tuple[HandTemplate, np.ndarray | None]:
    """Read a rigged hand as a template without shape parameters, open at the wrist only.

    Also its base colour, (H, W, 3) uint8 sRGB, or None if it has none.
    """
    file = read_skinned_mesh(Path(path))
    index, told = hand_joints(file.joint_names, side, path)
    places = file.joint_places[index]
    own = told or side_of_name(Path(path).stem) or _side_by_curl(places)
    flip = np.array([1.0 if model.side == own else -1.0, 1.0, 1.0])
    target, target_tips = model.joints * flip, model.vertices[model.fingertips] * flip
    turn, scale = _alignment(places, target, path)
    joints = (places - places[0]) @ turn.T * scale + target[0]
    mesh = _welded(file, index, told, scale)
    vertices = (mesh.vertices - places[0] * scale) @ turn.T + target[0]
    forward = np.array([-1.0 if own == "right" else 1.0, 0.0, 0.0])
    mesh = opened_at_wrist(replace(mesh, vertices=vertices), joints, forward, path)
    if len(mesh.faces) > MAX_HAND_FACES:
        problem = f"the hand has {len(mesh.faces)} triangles, at most {MAX_HAND_FACES}"
        raise BadHandModel(problem, where=path, remedy="Decimate the mesh.")
    uv, face_uv = mesh.uv, mesh.face_uv
    if file.sheet.texture is None:
        uv, face_uv = paintable(uv, face_uv)
    tips = _fingertips(mesh, joints, path)
    vertices, joints = into_rest_pose(mesh, joints, mesh.vertices[tips], target, target_tips)
    template = make_template(
        name=f"gltf:{Path(path).name}",
        side=own,
        vertices=vertices,
        faces=mesh.faces,
        shape_basis=np.zeros((len(vertices), 3, SHAPE_COUNT)),
        pose_basis=None,
        joints=joints,
        joint_basis=np.zeros((JOINT_COUNT, 3, SHAPE_COUNT)),
        weights=mesh.weights,
        mean_pose=np.zeros(3 * (JOINT_COUNT - 1)),
        uv=uv,
        face_uv=face_uv,
        fingertips=tips,
        where=path,
    )
    return template if own == side else mirror_template(template), file.sheet.texture


def _side_by_curl(places: np.ndarray) -> str:
    """Tell the side of a hand from the direction in which its fingers curl."""
    back_if_right = np.cross(places[4] - places[0], places[1] - places[7])
    curl = sum(places[i + 2] - places[i] for i in (1, 4, 7, 10, 13))
    return "right" if curl @ back_if_right < 0 else "left"


def _welded(file: SkinnedMesh, index: list[int], told: str | None, scale: float) -> RigMesh:
    """The file's mesh in metres with the hand model's weights, without the rest of a body.

    Files repeat vertices along the texture's seams; a closed surface needs them once.
    """
    _, first, welded = np.unique(
        np.round(file.vertices * scale, 6), axis=0, return_index=True, return_inverse=True
    )
    faces = welded.reshape(-1)[file.faces]
    owner = np.zeros((len(file.joint_names), JOINT_COUNT))
    elsewhere = np.zeros(len(file.joint_names))
    for joint, name in enumerate(file.joint_names):
        owner[joint, _owner(file, index, joint)] = 1.0
        # The rest of the body, or the other hand.
        other = told is not None and side_of_name(name) not in (None, told)
        elsewhere[joint] = joint not in index and bool(_BODY & set(words(name)) or other)
    shares = file.weights[first]
    total = np.maximum(np.asarray(shares.sum(axis=1)).reshape(-1), 1e-9)
    weights = np.asarray((shares @ owner) / total[:, None])
    # A vertex that nothing moves stays with the palm.
    weights[weights.sum(axis=1) < 0.5, 0] = 1.0
    weights /= weights.sum(axis=1, keepdims=True)
    away = np.asarray(shares @ elsewhere) / total
    solid = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    mesh = RigMesh(file.vertices[first] * scale, weights, faces, file.sheet.uv, file.sheet.faces)
    return kept(mesh, solid & (away[faces].mean(axis=1) < 0.5))


def _owner(file: SkinnedMesh, index: list[int], joint: int) -> int:
    """Joint of the hand model that a joint of the rig hands its weights to."""
    if joint in index:
        return index.index(joint)
    folded = any(part in file.joint_names[joint].lower() for part in _FOLDED)
    while joint >= 0 and joint not in index:
        joint = file.joint_parents[joint]
    return 0 if folded or joint < 0 else index.index(joint)


def _alignment(places: np.ndarray, target: np.ndarray, path: str) -> tuple[np.ndarray, float]:
    """Rotation and scale that bring the rig's wrist and knuckles onto the hand model's."""
    palm = [0, 1, 4, 7, 10]
    a = places[palm] - places[palm].mean(axis=0)
    b = target[palm] - target[palm].mean(axis=0)
    size = float(np.linalg.norm(a))
    if size < 1e-9:
        raise BadHandModel("has all joints of its palm in one place", where=path)
    return best_turn(a / size, b), float(np.linalg.norm(b)) / size


def _fingertips(mesh: RigMesh, joints: np.ndarray, path: str) -> np.ndarray:
    """Vertices of the fingers' last segments that lie farthest along them: (5,)."""
    tips = []
    for finger, joint in zip(FINGERS, _LAST, strict=True):
        weight = mesh.weights[:, joint]
        if weight.max() < 0.01:
            raise BadHandModel(f"no skin follows the last joint of the {finger}", where=path)
        along = mesh.vertices @ (joints[joint] - joints[joint - 1])
        tips.append(int(np.argmax(np.where(weight > 0.5 * weight.max(), along, -np.inf))))
    return np.array(tips)
