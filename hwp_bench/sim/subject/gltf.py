"""One skinned mesh read from a glTF 2.0 file; input from outside is not trusted."""

from __future__ import annotations

import base64
import binascii
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.errors import BadHandModel

#: Largest file that is read, in bytes.
MAX_BYTES = 256 * 1024 * 1024
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Gltf:
    """The first skinned mesh of a file.

    Args:
        path: a `.glb` or `.gltf` file.

    Raises:
        BadHandModel: missing, damaged, too large, or without a skinned mesh.
    """

    def __init__(self, path: Path) -> None:
        import pygltflib

        self._path = path
        if not path.is_file() or path.stat().st_size > MAX_BYTES:
            raise self._wrong("does not exist or is too large")
        try:
            self._file = pygltflib.GLTF2().load(str(path))
            self._read()
        except BadHandModel:
            raise
        except Exception as error:
            # The library raises whatever its parsers raise; all of it means a damaged file.
            raise self._wrong(f"is not a readable glTF file ({error})") from error

    def _wrong(self, problem: str) -> BadHandModel:
        return BadHandModel(problem, where=self._path)

    def _read(self) -> None:
        if self._file is None or not self._file.skins or not self._file.meshes:
            raise self._wrong("holds no skinned mesh")
        nodes = self._file.nodes
        mesh_node = next(
            (i for i, n in enumerate(nodes) if n.mesh is not None and n.skin is not None), None
        )
        if mesh_node is None:
            raise self._wrong("holds no node with a mesh and a skin")
        skin = self._file.skins[nodes[mesh_node].skin]
        primitive = self._file.meshes[nodes[mesh_node].mesh].primitives[0]
        attributes = primitive.attributes
        #: (V, 3) vertices in the bind pose.
        self.vertices = self._array(attributes.POSITION).astype(np.float64)
        #: (F, 3).
        self.faces = self._array(primitive.indices).reshape(-1, 3).astype(np.int64)
        #: (V, 2), origin at the bottom left.
        self.uv = np.zeros((len(self.vertices), 2))
        if attributes.TEXCOORD_0 is not None:
            self.uv = self._array(attributes.TEXCOORD_0).astype(np.float64) * [1, -1] + [0, 1]
        #: Names of the skin's joints.
        self.joint_names = [nodes[joint].name or "" for joint in skin.joints]
        #: (J, 3) places of the joints in the bind pose, in the mesh's frame.
        inverse = self._array(skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
        self.joint_places = np.linalg.inv(inverse.astype(np.float64))[:, :3, 3]
        #: Parent of each joint among the joints, or -1.
        self.joint_parents = self._parents(skin.joints)
        #: (V, J) skinning weights.
        self.weights = self._weights(attributes, len(skin.joints))
        #: (H, W, 3) uint8 sRGB base colour, or None.
        self.texture = self._texture(primitive)

    def _array(self, index: int | None) -> np.ndarray:
        if index is None:
            raise self._wrong("lacks an attribute that a skinned mesh needs")
        accessor = self._file.accessors[index]
        view = self._file.bufferViews[accessor.bufferView]
        blob = self._blob(view.buffer)
        kind, width = np.dtype(_TYPES[accessor.componentType]), _WIDTHS[accessor.type]
        start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
        stride = view.byteStride or width * kind.itemsize
        end = start + stride * (accessor.count - 1) + width * kind.itemsize
        if not 0 < accessor.count <= MAX_BYTES or end > len(blob):
            raise self._wrong("is cut short")
        rows = np.ndarray(
            (accessor.count, width), kind, blob, start, (stride, kind.itemsize)
        ).copy()
        return rows if width > 1 else rows[:, 0]

    def _blob(self, index: int) -> bytes:
        uri = self._file.buffers[index].uri
        if uri is None:
            return bytes(self._file.binary_blob() or b"")
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.split(",", 1)[1])
            except (IndexError, binascii.Error) as error:
                raise self._wrong("holds damaged data") from error
        from hwp_bench.base.files import inside

        return inside(self._path.parent, uri).read_bytes()

    def _weights(self, attributes: Any, count: int) -> np.ndarray:
        joints = self._array(attributes.JOINTS_0).astype(np.int64)
        values = self._array(attributes.WEIGHTS_0)
        if values.dtype.kind == "u":
            values = values / np.iinfo(values.dtype).max
        if joints.max() >= count:
            raise self._wrong("names a joint that the skin does not have")
        weights = np.zeros((len(joints), count))
        for column in range(joints.shape[1]):
            np.add.at(weights, (np.arange(len(joints)), joints[:, column]), values[:, column])
        return weights

    def _parents(self, joints: list[int]) -> list[int]:
        above = {
            child: parent
            for parent, node in enumerate(self._file.nodes)
            for child in node.children or []
        }
        place = {node: row for row, node in enumerate(joints)}
        return [place.get(above.get(node, -1), -1) for node in joints]

    def _texture(self, primitive: Any) -> np.ndarray | None:
        import cv2

        if primitive.material is None:
            return None
        surface = self._file.materials[primitive.material].pbrMetallicRoughness
        if surface is None or surface.baseColorTexture is None:
            return None
        source = self._file.textures[surface.baseColorTexture.index].source
        image = self._file.images[source]
        if image.bufferView is not None:
            view = self._file.bufferViews[image.bufferView]
            start = view.byteOffset or 0
            raw = self._blob(view.buffer)[start : start + view.byteLength]
        elif (image.uri or "").startswith("data:"):
            raw = base64.b64decode(image.uri.split(",", 1)[1])
        else:
            from hwp_bench.base.files import inside

            raw = inside(self._path.parent, image.uri).read_bytes()
        pixels = cv2.imdecode(np.frombuffer(raw, dtype=np.uint8), cv2.IMREAD_COLOR)
        if pixels is None:
            raise self._wrong("holds a texture that cannot be decoded")
        return np.ascontiguousarray(pixels[..., ::-1])
