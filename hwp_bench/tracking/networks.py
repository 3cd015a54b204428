"""The two networks: their files, and what they say of an image.

They are those of MediaPipe 0.10.21 (Apache License 2.0), the last release that contains its
networks: read from the cache, from a file that a person gives, or downloaded once. Its wheel is
downloaded from the Python package index and checked by its hash; the two networks and the licence
are kept, each checked by its own hash whenever it is read.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import os
import tempfile
import urllib.request
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from hwp_bench.base.errors import BadInput, HwpError, MissingDependency
from hwp_bench.base.files import atomic_write, cache_root, check_is_file
from hwp_bench.tracking.detection import (
    ANCHOR_COUNT,
    HAND_EDGE,
    PALM_EDGE,
    PALM_VALUES,
    SeenHand,
)

#: Largest network that is read, bytes.
MAX_NETWORK = 64 * 1024 * 1024
#: Most members of an archive that is looked through.
_MAX_MEMBERS = 100_000
#: Bytes 4 to 8 of every TensorFlow Lite file.
_MAGIC = b"TFL3"


@dataclass(frozen=True)
class Pinned:
    """A file whose content is known."""

    #: Path inside the wheel, or address.
    name: str
    #: Bytes.
    size: int
    #: Hex.
    sha256: str


@dataclass(frozen=True)
class HandModels:
    """The two networks, TensorFlow Lite files."""

    #: The palm detector, and the landmark network.
    palm: bytes
    hand: bytes
    #: Where they come from, for messages.
    source: str

    @property
    def digest(self) -> str:
        """SHA-256 (hex) over both."""
        return hashlib.sha256(self.palm + self.hand).hexdigest()


#: The wheel: that for Linux is the smallest, and its networks are those of every platform.
WHEEL = Pinned(
    "https://files.pythonhosted.org/packages/ad/83/"
    "56f760fecdc60de84c529d6c05c9dfc7d972617c6632bd254d5e021e5b16/"
    "mediapipe-0.10.21-cp311-cp311-manylinux_2_28_x86_64.whl",
    35_622_638,
    "05dc4a9e593655a79558d05d6227d31018c2537a4bd3362b51e230cf22aecfe3",
)
#: Names of the networks in the cache.
PALM, HAND = "palm_detection_full.tflite", "hand_landmark_full.tflite"
#: What is kept of the wheel, by its name in the cache.
MEMBERS: Mapping[str, Pinned] = {
    PALM: Pinned(
        f"mediapipe/modules/palm_detection/{PALM}",
        2_339_846,
        "1b14e9422c6ad006cde6581a46c8b90dd573c07ab7f3934b5589e7cea3f89a54",
    ),
    HAND: Pinned(
        f"mediapipe/modules/hand_landmark/{HAND}",
        5_478_917,
        "11c272b891e1a99ab034208e23937a8008388cf11ed2a9d776ed3d01d0ba00e3",
    ),
    "LICENSE": Pinned(
        "mediapipe-0.10.21.dist-info/LICENSE",
        12_331,
        "8707eef0533987efc5b155d64761eeb6e20793f50b9bd1a68dad1cf4719d0ed8",
    ),
}
#: The networks' names in a `hand_landmarker.task` of MediaPipe.
TASK_MEMBERS = ("hand_detector.tflite", "hand_landmarks_detector.tflite")
#: Makes a wheel that `--model` takes, for machines with a package index of their own.
PIP = (
    "pip download mediapipe==0.10.21 --no-deps --only-binary :all: --python-version 3.11 "
    "--platform manylinux_2_28_x86_64"
)

#: Opens an address; the result is read in pieces and closed.
Opener = Callable[[str], IO[bytes]]


def models_folder() -> Path:
    """Return the folder of the cache in which the networks lie."""
    return cache_root() / "models" / "mediapipe-hands-0.10.21"


def load_models(model: Path | None = None, *, opener: Opener | None = None) -> HandModels:
    """Read the networks, downloading them when they are in none of the places."""
    if model is None:
        folder = models_folder()
        if not all((folder / name).is_file() for name in (PALM, HAND)):
            fetch_models(opener=opener)
        return _from_folder(folder, pinned=True)
    if model.is_dir():
        return _from_folder(model, pinned=False)
    if model.suffix == ".whl":
        palm, hand = read_members(model, [MEMBERS[name].name for name in (PALM, HAND)])
        for name, content in ((PALM, palm), (HAND, hand)):
            _check(content, MEMBERS[name], f"{model}: {MEMBERS[name].name}")
    else:
        palm, hand = read_members(model, TASK_MEMBERS)
    return HandModels(_network(palm, model), _network(hand, model), os.fspath(model))


def fetch_models(*, opener: Opener | None = None, wheel: Pinned = WHEEL) -> Path:
    """Download the wheel and keep its networks and its licence in the cache.

    Returns:
        The folder.

    Raises:
        HwpError: the wheel cannot be downloaded.
        BadInput: it has another content than the pinned one.
    """
    folder = models_folder()
    with tempfile.TemporaryFile() as stream:
        _download(wheel, stream, opener or _open)
        kept = {}
        for name, member in MEMBERS.items():
            (content,) = read_members(stream, [member.name], where=wheel.name)
            _check(content, member, member.name)
            kept[name] = content
    for name, content in kept.items():
        atomic_write(folder / name, content)
    return folder


def read_members(
    archive: Path | IO[bytes], names: list[str] | tuple[str, ...], *, where: str | None = None
) -> list[bytes]:
    """Read members of a zip archive into memory, by exact names; nothing is unpacked to a path.

    `where` is the archive's name in messages.
    """
    where = where or os.fspath(archive)  # type: ignore[arg-type]
    try:
        with zipfile.ZipFile(archive) as opened:
            members = opened.infolist()
            if len(members) > _MAX_MEMBERS:
                raise BadInput(f"has {len(members)} members", where=where)
            return [_member(opened, members, name, where) for name in names]
    except BadInput:
        raise
    # A damaged archive can raise whatever zipfile or a decompressor raises.
    except Exception as error:
        reason = str(error).strip().split("\n")[0][:200] or type(error).__name__
        raise BadInput(
            f"is not a readable archive ({reason})",
            where=where,
            remedy="Give a hand_landmarker.task, or a wheel of MediaPipe 0.10.21.",
        ) from error


def _member(
    archive: zipfile.ZipFile, members: list[zipfile.ZipInfo], name: str, where: str
) -> bytes:
    found = [member for member in members if member.filename == name]
    if len(found) != 1:
        raise BadInput(f"contains {name} {len(found)} times, expected once", where=where)
    if found[0].file_size > MAX_NETWORK:
        raise BadInput(f"{name} has {found[0].file_size} bytes, above {MAX_NETWORK}", where=where)
    with archive.open(found[0]) as stream:
        content = stream.read(MAX_NETWORK + 1)
    if len(content) > MAX_NETWORK:
        raise BadInput(f"{name} unpacks to more than {MAX_NETWORK} bytes", where=where)
    return content


def _from_folder(folder: Path, *, pinned: bool) -> HandModels:
    contents = []
    for name in (PALM, HAND):
        path = folder / name
        check_is_file(path, remedy=f"The folder must contain {PALM} and {HAND}.")
        if path.stat().st_size > MAX_NETWORK:
            raise BadInput(f"is larger than {MAX_NETWORK} bytes", where=path)
        content = path.read_bytes()
        if pinned:
            _check(content, MEMBERS[name], os.fspath(path))
        contents.append(_network(content, path))
    return HandModels(contents[0], contents[1], os.fspath(folder))


def _network(content: bytes, where: Path) -> bytes:
    if content[4:8] != _MAGIC:
        raise BadInput("does not hold a TensorFlow Lite network", where=where)
    return content


def _check(content: bytes, expected: Pinned, where: str) -> None:
    digest = hashlib.sha256(content).hexdigest()
    if len(content) != expected.size or digest != expected.sha256:
        raise BadInput(
            f"has SHA-256 {digest[:16]} where {expected.sha256[:16]} is expected",
            where=where,
            remedy="It is damaged or was changed. Delete it and run the command again.",
        )


def _open(address: str) -> IO[bytes]:
    opened: IO[bytes] = urllib.request.urlopen(address, timeout=60)
    return opened


def _download(wheel: Pinned, target: IO[bytes], opener: Opener) -> None:
    """Copy the wheel into an open file; its size is bounded, its hash is checked."""
    digest, size = hashlib.sha256(), 0
    try:
        with opener(wheel.name) as stream:
            while size <= wheel.size and (piece := stream.read(1 << 20)):
                target.write(piece)
                digest.update(piece)
                size += len(piece)
    # urllib raises errors of sockets, TLS, HTTP and addresses.
    except Exception as error:
        reason = str(error).strip().split("\n")[0][:200] or type(error).__name__
        raise HwpError(
            f"the networks of the hand tracker are not in the cache and cannot be downloaded "
            f"({reason})",
            where=models_folder(),
            remedy="On a machine with network run `hwp-bench data track --fetch` and copy that "
            f"folder to this place; or give --model a wheel that `{PIP}` has made.",
        ) from error
    if size != wheel.size or digest.hexdigest() != wheel.sha256:
        raise BadInput(
            f"the download has {size} bytes and SHA-256 {digest.hexdigest()[:16]}, expected "
            f"{wheel.size} and {wheel.sha256[:16]}",
            where=wheel.name,
            remedy="Try again; if it differs again, do not trust it.",
        )


# --- The networks as functions of an image, run by LiteRT (the runtime of TensorFlow Lite)


class LiteRtNetworks:
    """MediaPipe's networks: they find palms, and the landmarks of a hand."""

    def __init__(self, models: HandModels, *, threads: int = 1) -> None:
        try:
            runtime: Any = importlib.import_module("ai_edge_litert.interpreter")
        except ImportError as error:
            raise MissingDependency(
                "ai-edge-litert is not installed, which runs the networks of the hand tracker",
                remedy="pip install 'hwp-bench[track]'",
            ) from error
        palm_outputs: list[tuple[int, ...]] = [(1, ANCHOR_COUNT, PALM_VALUES), (1, ANCHOR_COUNT, 1)]
        hand_outputs: list[tuple[int, ...]] = [(1, 63), (1, 1), (1, 1), (1, 63)]
        self._palm = _Network(runtime, models.palm, models.source, PALM_EDGE, palm_outputs, threads)
        self._hand = _Network(runtime, models.hand, models.source, HAND_EDGE, hand_outputs, threads)

    def palms(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find palms in (192, 192, 3) uint8 RGB.

        Boxes and keypoints (2016, 18), and logits of scores (2016,).
        """
        values, logits = self._palm(image)
        return values[0], logits[0, :, 0]

    def hand(self, image: np.ndarray) -> SeenHand:
        """Read the landmarks of the hand in an image, (224, 224, 3) uint8 RGB."""
        points, presence, right, world = self._hand(image)
        return SeenHand(
            points.reshape(21, 3), world.reshape(21, 3), float(presence[0, 0]), float(right[0, 0])
        )


class _Network:
    """One network: an image in, arrays out."""

    def __init__(
        self,
        runtime: Any,
        content: bytes,
        source: str,
        edge: int,
        outputs: list[tuple[int, ...]],
        threads: int,
    ) -> None:
        try:
            with _silent():
                self._run = runtime.Interpreter(model_content=content, num_threads=threads)
                self._run.allocate_tensors()
            (given,), results = self._run.get_input_details(), self._run.get_output_details()
            # Their order in the file is not fixed; their names count up.
            results = sorted(results, key=lambda result: str(result["name"]))
        # The runtime raises ValueError or RuntimeError, by what is wrong with the file.
        except Exception as error:
            reason = str(error).strip().split("\n")[0][:200]
            raise BadInput(
                f"holds a network that cannot be loaded ({reason})", where=source
            ) from error
        shapes = [tuple(int(size) for size in result["shape"]) for result in results]
        found = tuple(int(size) for size in given["shape"])
        if found != (1, edge, edge, 3) or shapes != outputs or given["dtype"] is not np.float32:
            raise BadInput(
                f"holds a network from {found} to {shapes}, expected (1, {edge}, {edge}, 3) to "
                f"{outputs}",
                where=source,
                remedy="Only MediaPipe's networks for hands can be used.",
            )
        self._given = given["index"]
        self._results = [result["index"] for result in results]

    def __call__(self, image: np.ndarray) -> list[np.ndarray]:
        self._run.set_tensor(self._given, image[None].astype(np.float32) / np.float32(255))
        self._run.invoke()
        return [self._run.get_tensor(index) for index in self._results]


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keep the runtime's own remarks, which it writes past Python, from standard error."""
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
