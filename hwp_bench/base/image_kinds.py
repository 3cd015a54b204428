"""Which image files are read at all, told from their first bytes before any decoder sees them."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import BinaryIO

from hwp_bench.base.errors import BadImage

#: First bytes by format. OpenImageIO reads dozens of others, among them film and raw formats,
#: whatever a file is called; a stranger's file must not choose such a decoder.
MAGIC = {
    "PNG": b"\x89PNG\r\n\x1a\n",
    "JPEG": b"\xff\xd8\xff",
    "BMP": b"BM",
}
#: Most parts of a PNG file that are looked through for an animation; writers put it first.
_MOST_CHUNKS = 1000


def check_kind(path: str | os.PathLike[str]) -> None:
    """Refuse what is no still PNG, JPEG or BMP.

    Raises:
        BadImage: missing, empty, no regular file, of another format, or an animated PNG.
    """
    path = Path(path)
    if not path.is_file():
        raise BadImage("does not exist", where=path)
    if path.stat().st_size == 0:
        raise BadImage("is empty (0 bytes)", where=path)
    try:
        with path.open("rb") as stream:
            head = stream.read(8)
            kind = next((name for name, magic in MAGIC.items() if head.startswith(magic)), None)
            if kind is None:
                raise BadImage(f"is no image that can be read (no {', '.join(MAGIC)})", where=path)
            if kind == "PNG" and _is_animated(stream):
                raise BadImage(
                    "is an animated PNG", where=path, remedy="Store each frame as a file."
                )
    except OSError as error:
        raise BadImage(f"cannot be read ({error.strerror})", where=path) from error


def _is_animated(stream: BinaryIO) -> bool:
    """Whether a PNG has an animation's header (acTL) before its first pixels (IDAT)."""
    for _ in range(_MOST_CHUNKS):
        head = stream.read(8)
        if len(head) < 8:
            return False
        length, kind = struct.unpack(">I4s", head)
        if kind in (b"acTL", b"IDAT"):
            return kind == b"acTL"
        stream.seek(length + 4, os.SEEK_CUR)
    return False
