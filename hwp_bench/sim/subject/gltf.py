"""A glTF 2.0 file: its arrays, images and nodes; input from outside is not trusted."""

from __future__ import annotations

import base64
import binascii
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.errors import BadHandModel

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
    """A file that was parsed; its parts are read when they are asked for.

    Args:
        path: a `.glb` or `.gltf` file.

    Raises:
        BadHandModel: missing, damaged, too large, or packed by an extension.
    """

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

        Args:
            index: of the accessor.

        Returns:
            (N, width) of the file's own type, or (N,) for scalars.

        Raises:
            BadHandModel: the accessor is absent, cut short or out of bounds.
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
        """An image of the file: (H, W, 3) uint8 sRGB.

        Raises:
            BadHandModel: it cannot be decoded, or is too large.
        """
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
        """A node and all nodes above it, lowest first.

        Raises:
            BadHandModel: a node stands above itself.
        """
        found = []
        while node >= 0:
            if node in found:
                raise self.wrong("has a node that stands above itself")
            found.append(node)
            node = above[node]
        return found

    def placed(self, nodes: list[int]) -> np.ndarray:
        """Product of the nodes' own transforms, highest first: (4, 4).

        Args:
            nodes: as `chain` gives them.
        """
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
