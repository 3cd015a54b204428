"""The skinned meshes of a glTF 2.0 file as one mesh in the bind pose; no file is trusted.

A file may hold several meshes, each with several primitives and a skin of its own. They are put
together through the joints that they share. Meshes without a skin below a joint (often
nails or rings) move with that joint. Their textures lie on one sheet.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hwp_bench.base.colors import eight_bit_srgb, srgb_to_linear
from hwp_bench.base.errors import BadHandModel

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


#: Largest file that is read, in bytes.
MAX_BYTES = 256 * 1024 * 1024
#: Most rows of one accessor.
MAX_ROWS = 4_000_000
#: Largest edge of a texture, px.
MAX_TEXTURE = 8192
#: Extensions without which no vertex can be read, and that are not understood.
_PACKED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Gltf:
    """A file that was parsed; its parts are read when they are asked for."""

    def __init__(self, path: Path) -> None:
        import pygltflib

        self.path = path
        if not path.is_file() or path.stat().st_size > MAX_BYTES:
            raise self.wrong("does not exist or is too large")
        try:
            #: The file as pygltflib parsed it.
            self.content: Any = pygltflib.GLTF2().load(str(path))
        except Exception as error:
            # The library raises whatever its parsers raise; all of it means a damaged file.
            raise self.wrong(f"is not a readable glTF file ({error})") from error
        if self.content is None:
            raise self.wrong("is not a readable glTF file")
        packed = [name for name in _PACKED if name in (self.content.extensionsRequired or [])]
        if packed:
            raise self.wrong(f"is packed with {packed[0]}", "Export it without compression.")

    def wrong(self, problem: str, remedy: str | None = None) -> BadHandModel:
        """An error about this file."""
        return BadHandModel(problem, where=self.path, remedy=remedy)

    def array(self, index: int | None) -> np.ndarray:
        """The rows of an accessor, sparse ones filled in.

        Returns (N, width) of the file's own type, or (N,) for scalars.
        """
        if index is None:
            raise self.wrong("lacks an attribute that a skinned mesh needs")
        accessor = self.content.accessors[index]
        kind, width = np.dtype(_TYPES[accessor.componentType]), _WIDTHS[accessor.type]
        if not 0 < accessor.count <= MAX_ROWS:
            raise self.wrong(f"has an accessor of {accessor.count} rows, at most {MAX_ROWS}")
        if accessor.bufferView is None:
            rows = np.zeros((accessor.count, width), dtype=kind)
        else:
            rows = self._rows(
                accessor.bufferView, accessor.byteOffset, accessor.count, kind, width, strided=True
            )
        if accessor.sparse is not None:
            self._fill(rows, accessor.sparse)
        return rows if width > 1 else rows[:, 0]

    def numbers(self, index: int | None) -> np.ndarray:
        """The rows of an accessor as float64, integers scaled where the file says so."""
        rows = self.array(index)
        if rows.dtype.kind in "iu" and self.content.accessors[index].normalized:
            return np.maximum(rows / np.iinfo(rows.dtype).max, -1.0)
        return rows.astype(np.float64)

    def image(self, index: int) -> np.ndarray:
        """An image of the file: (H, W, 3) uint8 sRGB."""
        import cv2

        image = self.content.images[index]
        if image.bufferView is not None:
            view = self.content.bufferViews[image.bufferView]
            start = view.byteOffset or 0
            raw = self._blob(view.buffer)[start : start + view.byteLength]
        else:
            raw = self._uri(image.uri or "")
        pixels = cv2.imdecode(np.frombuffer(raw, dtype=np.uint8), cv2.IMREAD_COLOR)
        if pixels is None:
            raise self.wrong("holds a texture that cannot be decoded")
        if max(pixels.shape) > MAX_TEXTURE:
            raise self.wrong(f"holds a texture of {max(pixels.shape)} px, at most {MAX_TEXTURE}")
        return np.ascontiguousarray(pixels[..., ::-1])

    def parents(self) -> list[int]:
        """Parent of every node, or -1."""
        above = [-1] * len(self.content.nodes)
        for parent, node in enumerate(self.content.nodes):
            for child in node.children or []:
                above[child] = parent
        return above

    def chain(self, node: int, above: list[int]) -> list[int]:
        """A node and all nodes above it, lowest first."""
        found = []
        while node >= 0:
            if node in found:
                raise self.wrong("has a node that stands above itself")
            found.append(node)
            node = above[node]
        return found

    def placed(self, nodes: list[int]) -> np.ndarray:
        """Product of the nodes' own transforms, highest first: (4, 4)."""
        whole = np.eye(4)
        for node in nodes:
            whole = _local(self.content.nodes[node]) @ whole
        return whole

    def _rows(
        self, index: int, offset: int | None, count: int, kind: np.dtype, width: int, strided: bool
    ) -> np.ndarray:
        view = self.content.bufferViews[index]
        blob = self._blob(view.buffer)
        start = (view.byteOffset or 0) + (offset or 0)
        stride = (view.byteStride if strided else None) or width * kind.itemsize
        end = start + stride * (count - 1) + width * kind.itemsize
        if start < 0 or stride <= 0 or end > len(blob):
            raise self.wrong("is cut short")
        return np.ndarray((count, width), kind, blob, start, (stride, kind.itemsize)).copy()

    def _fill(self, rows: np.ndarray, sparse: Any) -> None:
        count = sparse.count
        if not 0 < count <= len(rows):
            raise self.wrong(f"has a sparse accessor of {count} rows out of {len(rows)}")
        where, what = sparse.indices, sparse.values
        kind = np.dtype(_TYPES[where.componentType])
        places = self._rows(where.bufferView, where.byteOffset, count, kind, 1, strided=False)
        values = self._rows(
            what.bufferView, what.byteOffset, count, rows.dtype, rows.shape[1], strided=False
        )
        rows[places[:, 0].astype(np.int64)] = values

    def _blob(self, index: int) -> bytes:
        uri = self.content.buffers[index].uri
        return bytes(self.content.binary_blob() or b"") if uri is None else self._uri(uri)

    def _uri(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.split(",", 1)[1])
            except (IndexError, binascii.Error) as error:
                raise self.wrong("holds damaged data") from error
        from hwp_bench.base.files import inside

        target = inside(self.path.parent, uri)
        if not target.is_file() or target.stat().st_size > MAX_BYTES:
            raise self.wrong(f"names {uri!r}, which does not exist or is too large")
        return target.read_bytes()


def _local(node: Any) -> np.ndarray:
    if node.matrix:
        return np.array(node.matrix, dtype=np.float64).reshape(4, 4).T
    from scipy.spatial.transform import Rotation

    local = np.eye(4)
    if node.rotation:
        local[:3, :3] = Rotation.from_quat(node.rotation).as_matrix()
    if node.scale:
        local[:3, :3] *= np.array(node.scale, dtype=np.float64)
    if node.translation:
        local[:3, 3] = node.translation
    return local


#: Largest edge of a part's texture where several share a sheet, px.
TILE = 1024
# Edge in px of the grid on which overlaps are looked for, and the share that counts as one.
_GRID, _OVERLAP = 512, 1.15
# Least share of the sheet that usable coordinates cover.
_LEAST = 0.02
# Edge of a cell that two packed triangles share, of which the rest is margin.
_INNER = 0.84


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles with one material."""

    #: (V, 3) vertices.
    vertices: np.ndarray
    #: (F, 3).
    faces: np.ndarray
    #: (V, 2) texture coordinates, origin at the bottom left, or None.
    uv: np.ndarray | None
    #: (H, W, 3) uint8 sRGB, or None.
    texture: np.ndarray | None
    #: (3,) linear factor on the texture, or the colour where there is none.
    tint: np.ndarray


@dataclass(frozen=True, eq=False)
class Sheet:
    """Texture coordinates of all triangles, and the texture that they refer to."""

    #: (T, 2) coordinates, origin at the bottom left.
    uv: np.ndarray
    #: (F, 3) indices into `uv`.
    faces: np.ndarray
    #: (H, W, 3) uint8 sRGB, or None where nothing has a texture.
    texture: np.ndarray | None


def joined_sheet(parts: list[Part]) -> Sheet:
    """Put textures side by side, and coordinates with them."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    blank = [np.zeros((len(part.vertices), 2)) if part.uv is None else part.uv for part in parts]
    uv = np.concatenate(blank)
    if all(part.texture is None for part in parts):
        return Sheet(uv, faces, None)
    if len(parts) == 1:
        return Sheet(uv, faces, _tinted(parts[0]))
    corners = []
    for column, (part, own) in enumerate(zip(parts, blank, strict=True)):
        corner = own[part.faces]
        corner = corner - np.floor(corner.min(axis=1, keepdims=True) + 1e-9)
        corner = np.clip(corner, 0.0, 1.0)
        corner[..., 0] = (column + corner[..., 0]) / len(parts)
        corners.append(corner)
    joined = np.concatenate(corners)
    return Sheet(
        joined.reshape(-1, 2),
        np.arange(3 * len(joined)).reshape(-1, 3),
        _side_by_side([_tinted(part) for part in parts]),
    )


def paintable(uv: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates to paint skin on: these if every triangle has its own place, else packed ones.

    Takes `uv` (T, 2) coordinates of a whole mesh, `faces` (F, 3) indices into them.
    """
    return (uv, faces) if _apart(uv[faces]) else packed(len(faces))


def packed(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates in which every triangle has a place of its own.

    Returns (3 F, 2) coordinates in [0, 1], and (F, 3) indices into them.
    """
    edge = int(np.ceil(np.sqrt((count + 1) // 2)))
    cell = np.arange(count) // 2
    start = np.stack([cell % edge, cell // edge], axis=1)[:, None]
    low, high = (1.0 - _INNER) / 2, (1.0 + _INNER) / 2
    gap = (1.0 - _INNER) / 2
    lower = np.array([[low, low], [high - gap, low], [low, high - gap]])
    upper = np.array([[high, high], [low + gap, high], [high, low + gap]])
    shape = np.where((np.arange(count) % 2 == 0)[:, None, None], lower, upper)
    return ((start + shape) / edge).reshape(-1, 2), np.arange(3 * count).reshape(-1, 3)


def _apart(corners: np.ndarray) -> bool:
    """Whether triangles (F, 3, 2) lie in the unit square without covering one another much."""
    import cv2

    if not np.isfinite(corners).all() or corners.min() < -1e-3 or corners.max() > 1.0 + 1e-3:
        return False
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = float(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()) / 2.0
    image = np.zeros((_GRID, _GRID), dtype=np.uint8)
    for corner in np.round(corners * (_GRID - 1) * 16).astype(np.int32):
        cv2.fillConvexPoly(image, corner, 1, shift=4)
    return area > _LEAST and area <= _OVERLAP * float(image.mean())


def _tinted(part: Part) -> np.ndarray:
    """The part's colour in sRGB, (H, W, 3) uint8."""
    if part.texture is None:
        texture = np.full((1, 1, 3), 255, dtype=np.uint8)
    elif (part.tint >= 1.0).all():
        return part.texture
    else:
        texture = part.texture
    return eight_bit_srgb(srgb_to_linear(texture / 255.0) * part.tint)


def _side_by_side(textures: list[np.ndarray]) -> np.ndarray:
    import cv2

    edge = min(TILE, max(max(texture.shape[:2]) for texture in textures))
    edge = max(edge, 16)
    return np.concatenate(
        [
            cv2.resize(texture, (edge, edge), interpolation=cv2.INTER_AREA).reshape(edge, edge, 3)
            for texture in textures
        ],
        axis=1,
    )


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
    """Read everything that a file's skins and joints move."""
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
