"""Rigged hands from glTF files, brought into the hand model's joints, size and rest frame.

The rig keeps its own mesh, skinning weights and texture. Two naming schemes of joints are
understood: WebXR (`index-finger-phalanx-proximal`) and OpenXR as Godot writes it
(`Index_Proximal_R`). A left hand is made of a right one by mirroring, and the other way round.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from hwp_bench.base.errors import BadHandModel, MissingDependency
from hwp_bench.hands import HandTemplate, mirror_template
from hwp_bench.hands.template import JOINT_COUNT, SHAPE_COUNT, make_template
from hwp_bench.sim.subject.gltf import Gltf

#: Joints of the hand model, in its order, as WebXR names them.
WEBXR = (
    "wrist",
    *(
        f"{finger}-finger-phalanx-{part}"
        for finger in ("index", "middle", "pinky", "ring")
        for part in ("proximal", "intermediate", "distal")
    ),
    "thumb-metacarpal",
    "thumb-phalanx-proximal",
    "thumb-phalanx-distal",
)
#: The same as OpenXR rigs name them, without the side's suffix.
OPENXR = (
    "wrist",
    *(
        f"{finger}_{part}"
        for finger in ("index", "middle", "little", "ring")
        for part in ("proximal", "intermediate", "distal")
    ),
    "thumb_metacarpal",
    "thumb_proximal",
    "thumb_distal",
)
# Joints that the hand model does not have; their weights go to the joint named here.
_FOLDED: Mapping[str, str] = MappingProxyType({"metacarpal": "wrist", "palm": "wrist"})
_FINGERS = ("thumb", "index", "middle", "ring", "little")


def load_rig(path: str, side: str, model: HandTemplate) -> tuple[HandTemplate, np.ndarray | None]:
    """Read a rigged hand.

    Args:
        path: a `.glb` or `.gltf` file with one skinned hand.
        side: the hand to return; a rig of the other side is mirrored.
        model: the hand model of that side, whose size the rig takes.

    Returns:
        The rig as a template without shape parameters, and its base colour, (H, W, 3) uint8
        sRGB, or None if it has none.

    Raises:
        BadHandModel: the file is missing or damaged, or joints are missing; it names them.
        MissingDependency: pygltflib is not installed.
    """
    try:
        import pygltflib  # noqa: F401
    except ImportError as error:
        raise MissingDependency(
            "reading a glTF hand needs pygltflib", remedy="pip install 'hwp-bench[gltf]'"
        ) from error
    file = Gltf(Path(path))
    names = [name.lower() for name in file.joint_names]
    index = _joint_index(names, path)
    places = file.joint_places[index]
    own = _side_of(path, names, places)
    template = _template(file, names, index, own, places, model, path)
    if template.side != side:
        template = mirror_template(template)
    return template, file.texture


def _joint_index(names: list[str], path: str) -> list[int]:
    plain = [_plain(name) for name in names]
    for scheme in (WEBXR, OPENXR):
        if all(name in plain for name in scheme):
            return [plain.index(name) for name in scheme]
    missing = [name for name in WEBXR if name not in plain]
    raise BadHandModel(
        f"{len(missing)} joints are missing, the first is {missing[0]!r}",
        where=path,
        field="skins[0].joints",
        remedy="WebXR and OpenXR names are understood.",
    )


def _plain(name: str) -> str:
    for ending in ("_r", "_l", ".r", ".l", "_right", "_left"):
        name = name.removesuffix(ending)
    return name


def _side_of(path: str, names: list[str], places: np.ndarray) -> str:
    """The side by the file's or the joints' names, or by where the fingers curl.

    Args:
        path: the file.
        names: of the rig's joints.
        places: (16, 3) of the hand model's joints in the rig.
    """
    words = [Path(path).stem.lower(), *names]
    for side in ("right", "left"):
        endings = (side, f"_{side[0]}", f".{side[0]}")
        if any(word.endswith(endings) for word in words):
            return side
    back_if_right = np.cross(places[4] - places[0], places[1] - places[7])
    curl = sum(places[i + 2] - 2.0 * places[i + 1] + places[i] for i in (1, 4, 7, 10))
    curl = curl + places[13] - places[0]
    return "right" if curl @ back_if_right < 0 else "left"


def _template(
    file: Gltf,
    names: list[str],
    index: list[int],
    side: str,
    places: np.ndarray,
    model: HandTemplate,
    path: str,
) -> HandTemplate:
    target = model.joints if model.side == side else model.joints * [-1.0, 1.0, 1.0]
    turn, scale = _alignment(places, target)
    joints = (places - places[0]) @ turn.T * scale + target[0]
    # Files repeat the vertices along the texture's seams; a closed surface needs them once.
    _, first, welded = np.unique(
        np.round(file.vertices * scale, 6), axis=0, return_index=True, return_inverse=True
    )
    welded = welded.reshape(-1)
    vertices = (file.vertices[first] - places[0]) @ turn.T * scale + target[0]
    weights = np.zeros((len(vertices), JOINT_COUNT))
    for column, owner in enumerate(_owners(names, index, file.joint_parents)):
        weights[:, owner] += file.weights[first, column]
    tips = [
        _farthest(vertices, weights[:, joint], joints[joint] - joints[joint - 1])
        for joint in (15, 3, 6, 12, 9)
    ]
    return make_template(
        name=f"gltf:{Path(path).name}",
        side=side,
        vertices=vertices,
        faces=welded[file.faces],
        shape_basis=np.zeros((len(vertices), 3, SHAPE_COUNT)),
        pose_basis=None,
        joints=joints,
        joint_basis=np.zeros((JOINT_COUNT, 3, SHAPE_COUNT)),
        weights=weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-9),
        mean_pose=np.zeros(3 * (JOINT_COUNT - 1)),
        uv=file.uv,
        face_uv=file.faces,
        fingertips=np.array(tips),
        where=path,
    )


def _alignment(places: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, float]:
    """Rotation and scale that bring the rig's palm onto the hand model's.

    Source: the Kabsch algorithm over the wrist and the four knuckles.
    """
    palm = [0, 1, 4, 7, 10]
    a = places[palm] - places[palm].mean(axis=0)
    b = target[palm] - target[palm].mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return turn, float(np.linalg.norm(b)) / max(float(np.linalg.norm(a)), 1e-9)


def _owners(names: list[str], index: list[int], parents: list[int]) -> list[int]:
    """Joint of the hand model that each joint of the rig hands its weights to."""
    owners = []
    for joint, name in enumerate(names):
        plain = _plain(name)
        folded = next((to for part, to in _FOLDED.items() if part in plain), None)
        if joint in index:
            owners.append(index.index(joint))
        elif folded is not None:
            owners.append(0)
        else:
            ancestor = joint
            while ancestor >= 0 and ancestor not in index:
                ancestor = parents[ancestor]
            owners.append(index.index(ancestor) if ancestor >= 0 else 0)
    return owners


def _farthest(vertices: np.ndarray, weight: np.ndarray, direction: np.ndarray) -> int:
    """Vertex of a finger's last segment that lies farthest along it."""
    reach = np.where(weight > 0.5, vertices @ direction, -np.inf)
    return int(np.argmax(reach))
