"""Files whose content is known: downloaded with a bound on their size, checked by their SHA-256."""

from __future__ import annotations

import hashlib
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import IO

from hwp_bench.base.errors import BadInput, HwpError

#: Opens an address; the result is read in pieces and closed.
Opener = Callable[[str], IO[bytes]]


@dataclass(frozen=True)
class Pinned:
    """A file whose content is known."""

    #: Its address, or its path inside an archive.
    name: str
    #: Bytes.
    size: int
    #: Hex.
    sha256: str


def open_address(address: str) -> IO[bytes]:
    """Open an address of the web; 60 seconds without an answer are an error."""
    opened: IO[bytes] = urllib.request.urlopen(address, timeout=60)
    return opened


class NotAvailable(HwpError):
    """An address, or a folder in its place, does not give a file."""


def download(file: Pinned, target: IO[bytes], opener: Opener | None = None) -> None:
    """Copy what lies at an address into an open file.

    Raises:
        NotAvailable: it cannot be downloaded.
        OSError: the open file cannot be written.
        BadInput: it has another content than the pinned one.
    """
    digest, size = hashlib.sha256(), 0
    for piece in _pieces(file, opener):
        # Outside of what is taken for a fault of the network.
        target.write(piece)
        digest.update(piece)
        size += len(piece)
    if size != file.size or digest.hexdigest() != file.sha256:
        raise BadInput(
            f"the download has {size} bytes and SHA-256 {digest.hexdigest()[:16]}, expected "
            f"{file.size} and {file.sha256[:16]}",
            where=file.name,
            remedy="Try again; if it differs again, do not trust it.",
        )


def _pieces(file: Pinned, opener: Opener | None) -> Iterator[bytes]:
    """What lies at an address, up to a piece more than it may have."""
    size = 0
    try:
        with (opener or open_address)(file.name) as stream:
            while size <= file.size and (piece := stream.read(1 << 20)):
                size += len(piece)
                yield piece
    # urllib raises errors of sockets, TLS, HTTP and addresses.
    except Exception as error:
        reason = str(error).strip().split("\n")[0][:200] or type(error).__name__
        raise NotAvailable(f"cannot be downloaded ({reason})", where=file.name) from error
