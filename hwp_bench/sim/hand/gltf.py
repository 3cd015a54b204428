"""The skinned meshes of a glTF 2.0 file as one mesh in the bind pose; no file is trusted.

A file may hold several meshes, each with several primitives and a skin of its own. They are put
together through the joints that they share. Meshes without a skin below a joint (often
nails or rings) move with that joint. Their textures lie on one sheet.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import unquote

import numpy as np

from hwp_bench.base.colors import eight_bit_srgb, srgb_to_linear
from hwp_bench.base.errors import BadHandModel
from hwp_bench.base.files import inside

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


_Found = TypeVar("_Found")

#: Largest file that is read, in bytes.
MAX_BYTES = 256 * 1024 * 1024
#: Most rows of one accessor, and largest edge of a texture, px.
MAX_ROWS, MAX_TEXTURE = 4_000_000, 8192
#: Most vertices, triangles and joints of a file.
MAX_VERTICES, MAX_FACES, MAX_JOINTS = 500_000, 1_000_000, 2_048
# Largest coordinate that a hand has in any unit.
_LARGEST = 1e6
#: Extensions without which no vertex can be read, and that are not understood.
_PACKED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# Kinds of primitives that are triangles.
_LIST, _STRIP, _FAN = 4, 5, 6

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


def read_skinned_mesh(path: Path) -> SkinnedMesh:
    """Read everything that a file's skins and joints move."""
    return _guarded(path, _read)


def mesh_files(path: Path) -> list[Path]:
    """The files that a mesh is read from: its own, and those of its buffers and images."""
    return _guarded(path, _Gltf.files)


def _guarded(path: Path, read: Callable[[_Gltf], _Found]) -> _Found:
    try:
        with np.errstate(all="ignore"):
            return read(_Gltf(path))
    except BadHandModel:
        raise
    except Exception as error:
        # The library raises whatever its parsers raise, and indices, types and matrices of a
        # damaged file fail where they are used first.
        raise BadHandModel(f"is not a readable glTF file ({error})", where=path) from error


class _Gltf:
    """A file that was parsed; its parts are read when they are asked for."""

    def __init__(self, path: Path) -> None:
        import pygltflib

        self.path = path
        if not path.is_file() or path.stat().st_size > MAX_BYTES:
            raise self.wrong("does not exist or is too large")
        self.content: Any = pygltflib.GLTF2().load(str(path))
        packed = [name for name in _PACKED if name in (self.content.extensionsRequired or [])]
        if packed:
            raise self.wrong(f"is packed with {packed[0]}", "Export it without compression.")
        #: Parent of every node, or -1.
        self.above = [-1] * len(self.content.nodes)
        for parent, node in enumerate(self.content.nodes):
            for child in node.children or []:
                self.above[child] = parent

    def wrong(self, problem: str, remedy: str | None = None) -> BadHandModel:
        return BadHandModel(problem, where=self.path, remedy=remedy)

    def array(self, index: int | None) -> np.ndarray:
        """The rows of an accessor, (N, width) or (N,) of its own type, sparse ones filled in."""
        if index is None:
            raise self.wrong("lacks an attribute that a skinned mesh needs")
        accessor = self.content.accessors[index]
        kind, width = np.dtype(_TYPES[accessor.componentType]), _WIDTHS[accessor.type]
        if not 0 < accessor.count <= MAX_ROWS:
            raise self.wrong(f"has an accessor of {accessor.count} rows, at most {MAX_ROWS}")
        if accessor.bufferView is None:
            rows = np.zeros((accessor.count, width), dtype=kind)
        else:
            stride = self.content.bufferViews[accessor.bufferView].byteStride
            rows = self._rows(accessor, accessor.count, kind, width, stride)
        if (sparse := accessor.sparse) is not None:
            if not 0 < sparse.count <= len(rows):
                raise self.wrong(f"has a sparse accessor of {sparse.count} rows out of {len(rows)}")
            where = np.dtype(_TYPES[sparse.indices.componentType])
            places = self._rows(sparse.indices, sparse.count, where, 1)
            values = self._rows(sparse.values, sparse.count, kind, width)
            rows[places[:, 0].astype(np.int64)] = values
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

    def files(self) -> list[Path]:
        """The file, and the others that it names and that are there."""
        uris = [part.uri for part in (*self.content.buffers, *self.content.images) if part.uri]
        named = [self._beside(uri) for uri in uris if not uri.startswith("data:")]
        return [self.path, *(file for file in named if file.is_file())]

    def chain(self, node: int) -> list[int]:
        """A node and all nodes above it, lowest first."""
        found: list[int] = []
        while node >= 0:
            if node in found:
                raise self.wrong("has a node that stands above itself")
            found.append(node)
            node = self.above[node]
        return found

    def placed(self, nodes: list[int]) -> np.ndarray:
        """Product of the nodes' own transforms, highest first: (4, 4)."""
        whole = np.eye(4)
        for node in nodes:
            whole = _local(self.content.nodes[node]) @ whole
        return whole

    def _rows(
        self, part: Any, count: int, kind: np.dtype, width: int, stride: int | None = None
    ) -> np.ndarray:
        view = self.content.bufferViews[part.bufferView]
        blob = self._blob(view.buffer)
        start = (view.byteOffset or 0) + (part.byteOffset or 0)
        stride = stride or width * kind.itemsize
        end = start + stride * (count - 1) + width * kind.itemsize
        if start < 0 or stride <= 0 or end > len(blob):
            raise self.wrong("is cut short")
        return np.ndarray((count, width), kind, blob, start, (stride, kind.itemsize)).copy()

    def _blob(self, index: int) -> bytes:
        uri = self.content.buffers[index].uri
        return bytes(self.content.binary_blob() or b"") if uri is None else self._uri(uri)

    def _beside(self, uri: str) -> Path:
        """The file that a URI names; glTF 2.0 encodes its names, and some programs do not."""
        plain = inside(self.path.parent, uri)
        return plain if plain.is_file() else inside(self.path.parent, unquote(uri))

    def _uri(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.split(",", 1)[1])
            except (IndexError, binascii.Error) as error:
                raise self.wrong("holds damaged data") from error
        target = self._beside(uri)
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


def _read(file: _Gltf) -> SkinnedMesh:
    from scipy.sparse import csr_matrix, vstack

    content = file.content
    if not content.skins or not content.meshes:
        raise file.wrong("holds no skinned mesh")
    skinned = [node for node in content.nodes if None not in (node.mesh, node.skin)]
    if not skinned:
        raise file.wrong("holds no node with a mesh and a skin")
    #: Frame of every joint in the first skin's mesh, by node.
    frames: dict[int, np.ndarray] = {}
    parts: list[Part] = []
    #: Nodes that move each part's vertices, and their weights: (V, K) each.
    shares: list[tuple[np.ndarray, np.ndarray]] = []
    for node in skinned:
        nodes, own, bound = _skin(file, node.skin)
        move = np.eye(4)
        known = next((row for row, joint in enumerate(nodes) if joint in frames), None)
        if known is not None:
            move = frames[nodes[known]] @ np.linalg.inv(own[known])
        for joint, frame in zip(nodes, own, strict=True):
            frames.setdefault(joint, move @ frame)
        if len(frames) > MAX_JOINTS:
            raise file.wrong(f"has {len(frames)} joints, at most {MAX_JOINTS}")
        for part, attributes in _primitives(file, node.mesh):
            joints, values = _weights(file, attributes, len(part.vertices), len(nodes))
            vertices = part.vertices if bound else _skinned(part.vertices, joints, values, own)
            parts.append(replace(part, vertices=_moved(move, vertices)))
            shares.append((np.array(nodes)[joints], values))
    for part, joint in _hung(file, frames):
        parts.append(part)
        count = len(part.vertices)
        shares.append((np.full((count, 1), joint), np.ones((count, 1))))
    column = np.zeros(len(content.nodes), dtype=np.int64)
    column[list(frames)] = np.arange(len(frames))
    blocks = []
    for joints, values in shares:
        row = np.repeat(np.arange(len(values)), values.shape[1])
        entries = (values.ravel(), (row, column[joints].ravel()))
        blocks.append(csr_matrix(entries, shape=(len(values), len(frames))))
    weights = vstack(blocks).tocsr()
    vertices = np.concatenate([part.vertices for part in parts])
    faces = _joined_faces(parts)
    places = np.array([frame[:3, 3] for frame in frames.values()])
    if len(vertices) > MAX_VERTICES or len(faces) > MAX_FACES:
        problem = f"has more than {MAX_VERTICES} vertices or {MAX_FACES} triangles"
        raise file.wrong(problem, "Decimate the mesh.")
    for values in (vertices, places, weights.data):
        if not np.isfinite(values).all() or np.abs(values).max(initial=0.0) > _LARGEST:
            raise file.wrong("holds numbers that are not finite or too large")
    order = {joint: row for row, joint in enumerate(frames)}
    return SkinnedMesh(
        vertices=vertices,
        faces=faces,
        weights=weights,
        joint_names=[content.nodes[joint].name or "" for joint in frames],
        joint_places=places,
        joint_parents=[
            next((order[up] for up in file.chain(joint)[1:] if up in order), -1) for joint in frames
        ],
        sheet=joined_sheet(parts),
    )


def _skin(file: _Gltf, number: int) -> tuple[list[int], np.ndarray, bool]:
    """Node and frame, (J, 4, 4) in the mesh's bind pose, of each joint of a skin.

    Also whether the file states the frames; where it does not, the nodes pose the mesh.
    """
    skin = file.content.skins[number]
    nodes = [int(node) for node in skin.joints]
    if not 0 < len(nodes) <= MAX_JOINTS or len(set(nodes)) < len(nodes):
        raise file.wrong(f"has a skin of {len(nodes)} joints, or one joint twice")
    if skin.inverseBindMatrices is None:
        return nodes, np.array([file.placed(file.chain(node)) for node in nodes]), False
    inverse = file.numbers(skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
    return nodes, np.linalg.inv(inverse[: len(nodes)]), True


def _primitives(file: _Gltf, number: int) -> Iterator[tuple[Part, Any]]:
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
    step = np.arange(max(len(order) - 2, 0))
    if mode == _FAN:
        return np.stack([order[0 * step], order[step + 1], order[step + 2]], axis=1)
    odd = step % 2
    return np.stack([order[step], order[step + 1 + odd], order[step + 2 - odd]], axis=1)


def _surface(file: _Gltf, number: int | None) -> tuple[np.ndarray | None, np.ndarray]:
    """Base colour texture, (H, W, 3) uint8 sRGB, or None, and the linear tint on it."""
    material = None if number is None else file.content.materials[number].pbrMetallicRoughness
    if material is None:
        return None, np.ones(3)
    tint = np.clip(np.array(material.baseColorFactor or [1.0] * 4)[:3], 0.0, 1.0)
    if material.baseColorTexture is None:
        return None, tint
    return file.image(file.content.textures[material.baseColorTexture.index].source), tint


def _weights(
    file: _Gltf, attributes: Any, count: int, joint_count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Joints and weights of every vertex, all sets side by side: (V, 4 K) each."""
    joints: list[np.ndarray] = []
    values: list[np.ndarray] = []
    while not joints or getattr(attributes, f"JOINTS_{len(joints)}", None) is not None:
        number = len(joints)
        joints.append(file.array(getattr(attributes, f"JOINTS_{number}", None)).astype(np.int64))
        raw = file.array(getattr(attributes, f"WEIGHTS_{number}", None))
        values.append(raw / np.iinfo(raw.dtype).max if raw.dtype.kind in "iu" else raw)
        if joints[-1].shape != (count, 4) or values[-1].shape != (count, 4):
            raise file.wrong("has skinning weights of another number than vertices")
    of, share = np.hstack(joints), np.clip(np.hstack(values).astype(np.float64), 0.0, None)
    if of.min() < 0 or (of[share > 0] >= joint_count).any():
        raise file.wrong("names a joint that the skin does not have")
    return np.minimum(of, joint_count - 1), share


def _hung(file: _Gltf, frames: dict[int, np.ndarray]) -> Iterator[tuple[Part, int]]:
    """Meshes without a skin below a joint, moved to where they are in the bind pose."""
    for number, node in enumerate(file.content.nodes):
        if node.mesh is None or node.skin is not None:
            continue
        chain = file.chain(number)
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


def _joined_faces(parts: list[Part]) -> np.ndarray:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])


def joined_sheet(parts: list[Part]) -> Sheet:
    """Put textures side by side, and coordinates with them."""
    import cv2

    uvs = [np.zeros((len(part.vertices), 2)) if part.uv is None else part.uv for part in parts]
    if len(parts) == 1 or all(part.texture is None for part in parts):
        texture = None if parts[0].texture is None else _tinted(parts[0])
        return Sheet(np.concatenate(uvs), _joined_faces(parts), texture)
    corners = []
    for column, (part, uv) in enumerate(zip(parts, uvs, strict=True)):
        corner = uv[part.faces]
        corner = corner - np.floor(corner.min(axis=1, keepdims=True) + 1e-9)
        corner = np.clip(corner, 0.0, 1.0)
        corner[..., 0] = (column + corner[..., 0]) / len(parts)
        corners.append(corner)
    joined = np.concatenate(corners)
    tiles = [_tinted(part) for part in parts]
    edge = max(min(TILE, max(max(tile.shape[:2]) for tile in tiles)), 16)
    tiles = [
        cv2.resize(tile, (edge, edge), interpolation=cv2.INTER_AREA).reshape(edge, edge, 3)
        for tile in tiles
    ]
    return Sheet(
        joined.reshape(-1, 2),
        np.arange(3 * len(joined)).reshape(-1, 3),
        np.concatenate(tiles, axis=1),
    )


def _tinted(part: Part) -> np.ndarray:
    """The part's colour in sRGB, (H, W, 3) uint8."""
    if part.texture is not None and (part.tint >= 1.0).all():
        return part.texture
    texture = np.full((1, 1, 3), 255, np.uint8) if part.texture is None else part.texture
    return eight_bit_srgb(srgb_to_linear(texture / 255.0) * part.tint)


def paintable(uv: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates to paint skin on: these if every triangle has its own place, else packed ones.

    Takes `uv` (T, 2) coordinates of a whole mesh, `faces` (F, 3) indices into them.
    """
    return (uv, faces) if _apart(uv[faces]) else packed(len(faces))


def packed(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates (3 F, 2) in [0, 1] in which each triangle has its own place; (F, 3) indices."""
    edge = int(np.ceil(np.sqrt((count + 1) // 2)))
    cell = np.arange(count) // 2
    start = np.stack([cell % edge, cell // edge], axis=1)[:, None]
    gap, high = (1.0 - _INNER) / 2, (1.0 + _INNER) / 2
    lower = np.array([[gap, gap], [high - gap, gap], [gap, high - gap]])
    upper = np.array([[high, high], [gap + gap, high], [high, gap + gap]])
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
