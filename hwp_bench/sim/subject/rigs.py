"""Rigged hands from glTF files, brought into the hand model's joints, size and rest frame.

The rig keeps its own mesh, skinning weights and texture. A left hand is made of a right one by
mirroring, and the other way round. Meshes of any topology are taken, open or closed at the
wrist, with a forearm or a whole body: see `wrist`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hwp_bench.base.errors import BadHandModel, UsageError
from hwp_bench.hands import HandTemplate, mirror_template
from hwp_bench.hands.skeleton import JOINT_COUNT, SHAPE_COUNT
from hwp_bench.hands.template import make_template
from hwp_bench.sim.subject.joint_names import hand_joints, is_elsewhere, side_of_name
from hwp_bench.sim.subject.rest_pose import into_rest_pose
from hwp_bench.sim.subject.rig_mesh import RigMesh, kept
from hwp_bench.sim.subject.skinned_mesh import SkinnedMesh, read_skinned_mesh
from hwp_bench.sim.subject.texture_sheet import paintable
from hwp_bench.sim.subject.wrist import opened_at_wrist

#: Most triangles of a hand; images here are too small to show more.
MAX_HAND_FACES = 250_000
#: What a subject's `model` begins with: the path of a file follows, or the name of a rig that
#: comes with the package.
FROM_FILE, SHIPPED = "gltf:", "rig:"
_FOLDER = Path(__file__).with_name("rig_files")
# Joints of the palm, which the hand model does not have; the wrist takes their weights.
_FOLDED = ("metacarpal", "palm")
_FINGERS = ("thumb", "index", "middle", "ring", "little")
# Last joints of the fingers, in that order.
_LAST = (15, 3, 6, 12, 9)


def rig_path(model: str) -> str | None:
    """The file of a subject's rig, or None where `model` names no rig.

    Raises:
        UsageError: no rig of that name comes with the package.
    """
    if model.startswith(FROM_FILE):
        return model.removeprefix(FROM_FILE)
    if not model.startswith(SHIPPED):
        return None
    known = {path.stem: str(path) for path in sorted(_FOLDER.glob("*.glb"))}
    name = model.removeprefix(SHIPPED)
    if name not in known:
        raise UsageError(
            f"there is no rig {name!r}",
            field="subject.model",
            remedy=f"Known: {', '.join(known)}; or gltf: and the path of a file.",
        )
    return known[name]


def load_rig(path: str, side: str, model: HandTemplate) -> tuple[HandTemplate, np.ndarray | None]:
    """Read a rigged hand.

    Args:
        path: a `.glb` or `.gltf` file with a skinned hand.
        side: the hand to return; a rig of the other side is mirrored.
        model: the hand model of that side, whose size and rest pose the rig takes.

    Returns:
        The rig as a template without shape parameters, open at the wrist only, and its base
        colour, (H, W, 3) uint8 sRGB, or None if it has none.

    Raises:
        BadHandModel: the file is missing or damaged, joints are missing (it names them), or the
            mesh has no wrist.
    """
    file = read_skinned_mesh(Path(path))
    index, told = hand_joints(file.joint_names, side, path)
    places = file.joint_places[index]
    own = told or side_of_name(Path(path).stem) or _side_by_curl(places)
    template = _template(file, index, told, own, model, path)
    if template.side != side:
        template = mirror_template(template)
    return template, file.sheet.texture


def _side_by_curl(places: np.ndarray) -> str:
    """The side of a hand by where its fingers curl.

    Args:
        places: (16, 3) of the hand model's joints in the rig.
    """
    back_if_right = np.cross(places[4] - places[0], places[1] - places[7])
    curl = sum(places[i + 2] - places[i] for i in (1, 4, 7, 10, 13))
    return "right" if curl @ back_if_right < 0 else "left"


def _template(
    file: SkinnedMesh,
    index: list[int],
    told: str | None,
    side: str,
    model: HandTemplate,
    path: str,
) -> HandTemplate:
    flip = np.array([1.0 if model.side == side else -1.0, 1.0, 1.0])
    target, target_tips = model.joints * flip, model.vertices[model.fingertips] * flip
    places = file.joint_places[index]
    turn, scale = _alignment(places, target, path)
    joints = (places - places[0]) @ turn.T * scale + target[0]
    mesh = _welded(file, index, told, scale)
    vertices = (mesh.vertices - places[0] * scale) @ turn.T + target[0]
    mesh = RigMesh(vertices, mesh.weights, mesh.faces, mesh.uv, mesh.face_uv)
    forward = np.array([-1.0 if side == "right" else 1.0, 0.0, 0.0])
    mesh = opened_at_wrist(mesh, joints, forward, path)
    if len(mesh.faces) > MAX_HAND_FACES:
        raise BadHandModel(
            f"the hand has {len(mesh.faces)} triangles, at most {MAX_HAND_FACES}",
            where=path,
            remedy="Decimate the mesh.",
        )
    uv, face_uv = mesh.uv, mesh.face_uv
    if file.sheet.texture is None:
        uv, face_uv = paintable(uv, face_uv)
    tips = _fingertips(mesh, joints, path)
    vertices, joints = into_rest_pose(
        mesh.vertices, mesh.weights, joints, mesh.vertices[tips], target, target_tips
    )
    return make_template(
        name=f"gltf:{Path(path).name}",
        side=side,
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


def _welded(file: SkinnedMesh, index: list[int], told: str | None, scale: float) -> RigMesh:
    """The file's mesh in metres with the hand model's weights, without the rest of a body.

    Files repeat vertices along the texture's seams; a closed surface needs them once.
    """
    _, first, welded = np.unique(
        np.round(file.vertices * scale, 6), axis=0, return_index=True, return_inverse=True
    )
    faces = welded.reshape(-1)[file.faces]
    owner = np.zeros((len(file.joint_names), JOINT_COUNT))
    owner[np.arange(len(owner)), _owners(file.joint_names, index, file.joint_parents)] = 1.0
    elsewhere = np.array(
        [is_elsewhere(name, told) and row not in index for row, name in enumerate(file.joint_names)]
    )
    shares = file.weights[first]
    total = np.maximum(np.asarray(shares.sum(axis=1)).reshape(-1), 1e-9)
    weights = np.asarray((shares @ owner) / total[:, None])
    # A vertex that nothing moves stays with the palm.
    weights[weights.sum(axis=1) < 0.5, 0] = 1.0
    weights /= weights.sum(axis=1, keepdims=True)
    away = np.asarray(shares @ elsewhere.astype(np.float64)) / total
    solid = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    sheet = file.sheet
    mesh = RigMesh(file.vertices[first] * scale, weights, faces, sheet.uv, sheet.faces)
    return kept(mesh, solid & (away[faces].mean(axis=1) < 0.5))


def _alignment(places: np.ndarray, target: np.ndarray, path: str) -> tuple[np.ndarray, float]:
    """Rotation and scale that bring the rig's palm onto the hand model's.

    Source: the Kabsch algorithm over the wrist and the four knuckles.
    """
    palm = [0, 1, 4, 7, 10]
    a = places[palm] - places[palm].mean(axis=0)
    b = target[palm] - target[palm].mean(axis=0)
    size = float(np.linalg.norm(a))
    if size < 1e-9:
        raise BadHandModel("has all joints of its palm in one place", where=path)
    u, _, vt = np.linalg.svd(b.T @ (a / size))
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return turn, float(np.linalg.norm(b)) / size


def _owners(names: list[str], index: list[int], parents: list[int]) -> list[int]:
    """Joint of the hand model that each joint of the rig hands its weights to."""
    owners = []
    for joint, name in enumerate(names):
        folded = any(part in name.lower() for part in _FOLDED)
        ancestor = joint
        while ancestor >= 0 and ancestor not in index:
            ancestor = parents[ancestor]
        if joint in index:
            owners.append(index.index(joint))
        elif folded or ancestor < 0:
            owners.append(0)
        else:
            owners.append(index.index(ancestor))
    return owners


def _fingertips(mesh: RigMesh, joints: np.ndarray, path: str) -> np.ndarray:
    """Vertices of the fingers' last segments that lie farthest along them: (5,)."""
    tips = []
    for finger, joint in zip(_FINGERS, _LAST, strict=True):
        weight = mesh.weights[:, joint]
        if weight.max() < 0.01:
            raise BadHandModel(f"no skin follows the last joint of the {finger}", where=path)
        along = mesh.vertices @ (joints[joint] - joints[joint - 1])
        tips.append(int(np.argmax(np.where(weight > 0.5 * weight.max(), along, -np.inf))))
    return np.array(tips)
