"""Building a binary glTF: arrays become buffer views and accessors of one buffer."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from hwp_bench.base.errors import BadInput

_TYPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_COMPONENTS = {"uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}
#: What a buffer view is for: vertex attributes, indices of corners, or neither.
ATTRIBUTES, INDICES, OTHER = 34962, 34963, None


class GlbBuilder:
    """Collects arrays and JSON of one glTF file.

    Args:
        generator: the program that writes it.

    Attributes:
        content: the JSON, to which the caller adds nodes, meshes and so on.
    """

    def __init__(self, generator: str) -> None:
        asset = {"version": "2.0", "generator": generator}
        self.content: dict[str, Any] = {"asset": asset, "accessors": [], "bufferViews": []}
        self._body = bytearray()

    def array(self, values: np.ndarray, target: int | None = OTHER, *, bounds: bool = False) -> int:
        """Add an array and return the number of its accessor.

        Args:
            values: (N,), (N, 2), (N, 3), (N, 4) or (N, 4, 4) of a type that glTF has; matrices are
                given by rows and kept by columns.
            target: one of this module's.
            bounds: write the least and the largest value, which positions and times need.

        Raises:
            BadInput: a number is NaN or infinite.
        """
        if not np.isfinite(values).all():
            raise BadInput(
                "holds NaN or infinity, which glTF does not know",
                field=f"array {len(self.content['accessors'])}",
                remedy="The avatar or the motion is damaged; nothing is written.",
            )
        kind = _TYPES[values.shape[1:]]
        flat = values.transpose(0, 2, 1) if kind == "MAT4" else values
        accessor: dict[str, Any] = {
            "bufferView": self._view(np.ascontiguousarray(flat).tobytes(), target),
            "componentType": _COMPONENTS[values.dtype.name],
            "count": len(values),
            "type": kind,
        }
        if bounds:
            rows = values.reshape(len(values), -1)
            accessor["min"] = rows.min(axis=0).tolist()
            accessor["max"] = rows.max(axis=0).tolist()
        self.content["accessors"].append(accessor)
        return len(self.content["accessors"]) - 1

    def image(self, png: bytes) -> int:
        """Add a PNG image and return its number."""
        images = self.content.setdefault("images", [])
        images.append({"bufferView": self._view(png, OTHER), "mimeType": "image/png"})
        return len(images) - 1

    def _view(self, data: bytes, target: int | None) -> int:
        self._body.extend(b"\0" * (-len(self._body) % 4))
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self._body), "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        self.content["bufferViews"].append(view)
        self._body.extend(data)
        return len(self.content["bufferViews"]) - 1

    def to_bytes(self) -> bytes:
        """Return the file: a header, a chunk of JSON and a chunk of binary data."""
        content = {**self.content, "buffers": [{"byteLength": len(self._body)}]}
        text = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        body = bytes(self._body) + b"\0" * (-len(self._body) % 4)
        length = 12 + 8 + len(text) + 8 + len(body)
        return b"".join(
            (
                struct.pack("<4sII", b"glTF", 2, length),
                struct.pack("<I4s", len(text), b"JSON"),
                text,
                struct.pack("<I4s", len(body), b"BIN\0"),
                body,
            )
        )
