"""The skinned meshes of a glTF file as one mesh in the bind pose.

A file may hold several meshes, each with several primitives and a skin of its own. They are put
together through the joints that they share. Meshes without a skin below a joint (often
nails or rings) move with that joint.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hwp_bench.base.errors import BadHandModel
from hwp_bench.sim.subject.gltf import Gltf
from hwp_bench.sim.subject.texture_sheet import Part, Sheet, joined_sheet

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

#: Most vertices, triangles and joints of a file.
MAX_VERTICES, MAX_FACES, MAX_JOINTS = 500_000, 1_000_000, 2_048
# Largest coordinate that a hand has in any unit.
_LARGEST = 1e6
# Kinds of primitives that are triangles.
_LIST, _STRIP, _FAN = 4, 5, 6


@dataclass(frozen=True, eq=False)
class SkinnedMesh:
    """A mesh and the skeleton that moves it, in the file's own frame and unit."""

    #: (V, 3) vertices in the bind pose.
    vertices: np.ndarray
    #: (F, 3).
    faces: np.ndarray
    #: (V, J) skinning weights as the file has them.
    weights: csr_matrix
    #: Names of the joints.
    joint_names: list[str]
    #: (J, 3) places of the joints in the bind pose.
    joint_places: np.ndarray
    #: Nearest joint above each joint, or -1.
    joint_parents: list[int]
    #: Texture coordinates and base colour.
    sheet: Sheet


@dataclass(frozen=True, eq=False)
class _Skin:
    """The joints of one skin."""

    #: Node of each joint.
    nodes: list[int]
    #: (J, 4, 4) from each joint's frame to the mesh, in the bind pose.
    frames: np.ndarray
    #: (J, 4, 4) the inverse as the file has it, or None: then the nodes pose the mesh.
    inverse: np.ndarray | None


def read_skinned_mesh(path: Path) -> SkinnedMesh:
    """Read everything that a file's skins and joints move.

    Args:
        path: a `.glb` or `.gltf` file.

    Raises:
        BadHandModel: missing, damaged, too large, packed, or without a skinned mesh.
    """
    file = Gltf(path)
    try:
        with np.errstate(all="ignore"):
            return _read(file)
    except BadHandModel:
        raise
    except Exception as error:
        # Indices, types and matrices of a damaged file fail where they are used first.
        raise file.wrong(f"is not a readable glTF file ({error})") from error


def _read(file: Gltf) -> SkinnedMesh:
    from scipy.sparse import csr_matrix, vstack

    content = file.content
    if not content.skins or not content.meshes:
        raise file.wrong("holds no skinned mesh")
    skinned = [n for n, node in enumerate(content.nodes) if None not in (node.mesh, node.skin)]
    if not skinned:
        raise file.wrong("holds no node with a mesh and a skin")
    above = file.parents()
    #: Frame of every joint in the first skin's mesh, by node.
    frames: dict[int, np.ndarray] = {}
    parts: list[Part] = []
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for number in skinned:
        skin = _skin(file, content.nodes[number].skin, above)
        move = np.eye(4)
        known = next((row for row, node in enumerate(skin.nodes) if node in frames), None)
        if known is not None:
            move = frames[skin.nodes[known]] @ np.linalg.inv(skin.frames[known])
        for node, frame in zip(skin.nodes, skin.frames, strict=True):
            frames.setdefault(node, move @ frame)
        if len(frames) > MAX_JOINTS:
            raise file.wrong(f"has {len(frames)} joints, at most {MAX_JOINTS}")
        for part, attributes in _primitives(file, content.nodes[number].mesh):
            joints, values = _weights(file, attributes, len(part.vertices), len(skin.nodes))
            vertices = part.vertices
            if skin.inverse is None:
                vertices = _skinned(vertices, joints, values, skin.frames)
            parts.append(replace(part, vertices=_moved(move, vertices)))
            rows.append((np.array(skin.nodes)[joints], values, np.arange(len(vertices))))
    for part, node in _hung(file, above, frames):
        parts.append(part)
        count = len(part.vertices)
        rows.append((np.full((count, 1), node), np.ones((count, 1)), np.arange(count)))
    nodes = list(frames)
    column = np.zeros(len(content.nodes), dtype=np.int64)
    column[nodes] = np.arange(len(nodes))
    weights = vstack(
        [
            csr_matrix(
                (values.ravel(), (np.repeat(row, values.shape[1]), column[joints].ravel())),
                shape=(len(row), len(nodes)),
            )
            for joints, values, row in rows
        ]
    ).tocsr()
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    places = np.array([frames[node][:3, 3] for node in nodes])
    if len(vertices) > MAX_VERTICES or sum(len(part.faces) for part in parts) > MAX_FACES:
        raise file.wrong(
            f"has more than {MAX_VERTICES} vertices or {MAX_FACES} triangles", "Decimate the mesh."
        )
    for values in (vertices, places, weights.data):
        if not np.isfinite(values).all() or np.abs(values).max(initial=0.0) > _LARGEST:
            raise file.wrong("holds numbers that are not finite or too large")
    return SkinnedMesh(
        vertices=vertices,
        faces=np.concatenate(
            [part.faces + start for part, start in zip(parts, starts, strict=False)]
        ),
        weights=weights,
        joint_names=[content.nodes[node].name or "" for node in nodes],
        joint_places=places,
        joint_parents=[
            next((nodes.index(up) for up in file.chain(node, above)[1:] if up in frames), -1)
            for node in nodes
        ],
        sheet=joined_sheet(parts),
    )


def _skin(file: Gltf, number: int, above: list[int]) -> _Skin:
    skin = file.content.skins[number]
    nodes = [int(node) for node in skin.joints]
    if not 0 < len(nodes) <= MAX_JOINTS or len(set(nodes)) < len(nodes):
        raise file.wrong(f"has a skin of {len(nodes)} joints, or one joint twice")
    if skin.inverseBindMatrices is None:
        frames = np.array([file.placed(file.chain(node, above)) for node in nodes])
        return _Skin(nodes, frames, None)
    inverse = file.numbers(skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
    inverse = inverse[: len(nodes)]
    return _Skin(nodes, np.linalg.inv(inverse), inverse)


def _primitives(file: Gltf, number: int) -> Iterator[tuple[Part, Any]]:
    """The primitives of a mesh that are triangles."""
    for primitive in file.content.meshes[number].primitives:
        mode = _LIST if primitive.mode is None else primitive.mode
        if mode not in (_LIST, _STRIP, _FAN):
            continue
        attributes = primitive.attributes
        vertices = file.numbers(attributes.POSITION)
        count = len(vertices)
        order = np.arange(count)
        if primitive.indices is not None:
            order = file.array(primitive.indices).astype(np.int64)
        faces = _triangles(order, mode)
        if not len(faces):
            continue
        if faces.min() < 0 or faces.max() >= count:
            raise file.wrong(f"names a vertex outside 0..{count - 1}")
        uv = None
        if attributes.TEXCOORD_0 is not None:
            uv = file.numbers(attributes.TEXCOORD_0) * [1.0, -1.0] + [0.0, 1.0]
        texture, tint = _surface(file, primitive.material)
        yield Part(vertices, faces, uv, texture, tint), attributes


def _triangles(order: np.ndarray, mode: int) -> np.ndarray:
    if mode == _LIST:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    if len(order) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    step = np.arange(len(order) - 2)
    if mode == _FAN:
        return np.stack([np.full(len(step), order[0]), order[step + 1], order[step + 2]], axis=1)
    odd = step % 2
    return np.stack([order[step], order[step + 1 + odd], order[step + 2 - odd]], axis=1)


def _surface(file: Gltf, number: int | None) -> tuple[np.ndarray | None, np.ndarray]:
    """Base colour texture, (H, W, 3) uint8 sRGB, or None, and the linear tint on it."""
    white = np.ones(3)
    if number is None:
        return None, white
    surface = file.content.materials[number].pbrMetallicRoughness
    if surface is None:
        return None, white
    tint = np.clip(np.array(surface.baseColorFactor or [1.0] * 4)[:3], 0.0, 1.0)
    if surface.baseColorTexture is None:
        return None, tint
    source = file.content.textures[surface.baseColorTexture.index].source
    return file.image(source), tint


def _weights(
    file: Gltf, attributes: Any, count: int, joint_count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Joints and weights of every vertex, all sets side by side: (V, 4 K) each."""
    joints, values = [], []
    number = 0
    while getattr(attributes, f"JOINTS_{number}", None) is not None or number == 0:
        joints.append(file.array(getattr(attributes, f"JOINTS_{number}", None)).astype(np.int64))
        raw = file.array(getattr(attributes, f"WEIGHTS_{number}", None))
        values.append(raw / np.iinfo(raw.dtype).max if raw.dtype.kind in "iu" else raw)
        if joints[-1].shape != (count, 4) or values[-1].shape != (count, 4):
            raise file.wrong("has skinning weights of another number than vertices")
        number += 1
    of, share = np.hstack(joints), np.clip(np.hstack(values).astype(np.float64), 0.0, None)
    if of.min() < 0 or (of[share > 0] >= joint_count).any():
        raise file.wrong("names a joint that the skin does not have")
    return np.minimum(of, joint_count - 1), share


def _hung(
    file: Gltf, above: list[int], frames: dict[int, np.ndarray]
) -> Iterator[tuple[Part, int]]:
    """Meshes without a skin below a joint, moved to where they are in the bind pose."""
    for number, node in enumerate(file.content.nodes):
        if node.mesh is None or node.skin is not None:
            continue
        chain = file.chain(number, above)
        depth = next((row for row, up in enumerate(chain) if up in frames), None)
        if depth is None:
            continue
        move = frames[chain[depth]] @ file.placed(chain[:depth])
        for part, _ in _primitives(file, node.mesh):
            yield replace(part, vertices=_moved(move, part.vertices)), chain[depth]


def _moved(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _skinned(
    points: np.ndarray, joints: np.ndarray, values: np.ndarray, frames: np.ndarray
) -> np.ndarray:
    """Linear blend skinning with the joints' own frames: (V, 3)."""
    posed = np.zeros_like(points)
    for column in range(joints.shape[1]):
        own = frames[joints[:, column]]
        there = np.einsum("vij,vj->vi", own[:, :3, :3], points) + own[:, :3, 3]
        posed += values[:, column, None] * there
    return posed / np.maximum(values.sum(axis=1, keepdims=True), 1e-9)
