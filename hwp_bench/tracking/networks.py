"""The two networks of MediaPipe for hands: their files, inputs and outputs.

They are those of MediaPipe 0.10.21 (Apache License 2.0), the last release that contains its
networks: read from the cache, from a file that a person gives, or downloaded once. Its wheel is
downloaded from the Python package index and checked by its hash; the two networks and the licence
are kept, each checked by its own hash whenever it is read.

Source of the geometry: the graphs `palm_detection_cpu`, `palm_detection_detection_to_roi`,
`hand_landmark_cpu` and `hand_landmark_landmarks_to_roi` of MediaPipe 0.10.21.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from hwp_bench.base.download import NotAvailable, Opener, Pinned, download
from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.base.files import atomic_write, cache_root, check_is_file, disc_errors
from hwp_bench.base.packages import import_extra

# --- Rotated regions of an image


@dataclass(frozen=True)
class Region:
    """A rectangle in an image, turned about its centre."""

    #: Centre, px from the left edge of the image.
    x: float
    #: Centre, px from its upper edge.
    y: float
    #: Px, along the rectangle's own first axis.
    width: float
    #: Px, along its second axis.
    height: float
    #: Rad, clockwise as the image is seen; 0 = upright.
    rotation: float = 0.0

    def matrix(self) -> np.ndarray:
        """Return (2, 3) float64: from the unit square (0, 0)-(1, 1) to pixels of the image."""
        cos, sin = math.cos(self.rotation), math.sin(self.rotation)
        linear = np.array(
            [[cos * self.width, -sin * self.height], [sin * self.width, cos * self.height]]
        )
        return np.column_stack([linear, np.array([self.x, self.y]) - linear.sum(axis=1) / 2])

    def grow(self, scale: float, shift: float) -> Region:
        """Return the square around this rectangle, moved and then scaled.

        Its edge is `scale` times the longer side; it is moved along the second axis by `shift`
        times the height. Source: MediaPipe's RectTransformationCalculator with `square_long`.
        """
        step = shift * self.height
        edge = scale * max(self.width, self.height)
        return Region(
            self.x - step * math.sin(self.rotation),
            self.y + step * math.cos(self.rotation),
            edge,
            edge,
            self.rotation,
        )


def full_square(width: int, height: int) -> Region:
    """Return the upright square around an image of this size, centred; bands are outside of it."""
    edge = float(max(width, height))
    return Region(width / 2, height / 2, edge, edge)


def angle_of(start: np.ndarray, end: np.ndarray) -> float:
    """The rotation of a region whose upward direction is from `start` to `end`, (2,) px.

    rad in [-pi, pi), clockwise; 0 where `end` is straight above `start`.
    """
    dx, dy = float(end[0] - start[0]), float(end[1] - start[1])
    angle = math.pi / 2 - math.atan2(-dy, dx)
    return angle - 2 * math.pi * math.floor((angle + math.pi) / (2 * math.pi))


def overlap(one: Region, other: Region) -> float:
    """Return the intersection over union of two regions, as if both were upright.

    Source: MediaPipe's AssociationNormRectCalculator leaves the rotation out too.
    """
    boxes = []
    for region in (one, other):
        centre, half = np.array([region.x, region.y]), np.array([region.width, region.height]) / 2
        boxes.append((centre - half, centre + half))
    return _box_overlap(*boxes[0], *boxes[1])


def _box_overlap(
    low: np.ndarray, high: np.ndarray, other_low: np.ndarray, other_high: np.ndarray
) -> float:
    """Intersection over union of two boxes, each from its lower to its upper corner."""
    shared = np.prod(np.clip(np.minimum(high, other_high) - np.maximum(low, other_low), 0, None))
    union = np.prod(high - low) + np.prod(other_high - other_low) - shared
    return float(shared / union) if union > 0 else 0.0


def cut_region(image: np.ndarray, region: Region, edge: int, *, outside_black: bool) -> np.ndarray:
    """Resample a region, which may reach beyond its image, into a square: (edge, edge, 3) uint8.

    What lies outside the image is black, or the image's edge continues. Position (0, 0) is the
    region's first corner, as in MediaPipe's ImageToTensorCalculator, which samples bilinearly and
    does not smooth.
    """
    import cv2

    matrix = region.matrix()
    matrix[:, :2] /= edge
    border = cv2.BORDER_CONSTANT if outside_black else cv2.BORDER_REPLICATE
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, matrix, (edge, edge), flags=flags, borderMode=border)


def to_image(points: np.ndarray, region: Region) -> np.ndarray:
    """Map (..., 2) points of a region's unit square to pixels of the image."""
    matrix = region.matrix()
    return points @ matrix[:, :2].T + matrix[:, 2]


# --- Palms

#: Edge of the images that the detector takes, px.
PALM_EDGE = 192
#: Rows of anchors and columns of them, and anchors at each place: strides 8, and 16 three times.
_GRIDS = ((24, 2), (12, 6))
#: Number of anchors.
ANCHOR_COUNT = sum(cells * cells * each for cells, each in _GRIDS)
#: A box (centre, size) and seven keypoints.
PALM_VALUES = 18
#: Keypoints that say how the hand is turned: the wrist, and the base of the middle finger.
_PALM_WRIST, _PALM_MIDDLE = 0, 2
#: Boxes with more overlap than this are one palm.
_SAME_PALM = 0.3
#: From the palm's box to the hand's region: scale, and shift towards the fingers.
_PALM_GROWTH, _PALM_SHIFT = 2.6, -0.5


@dataclass(frozen=True, eq=False)
class Palm:
    """A palm that was found."""

    #: (2,) upper left corner of its box, px of the image.
    low: np.ndarray
    #: (2,) lower right corner.
    high: np.ndarray
    #: (7, 2) px; the wrist is the first, the base of the middle finger the third.
    keypoints: np.ndarray
    #: In [0, 1].
    score: float

    def hand_region(self) -> Region:
        """Return the square that shows the whole hand, with its fingers upwards."""
        centre, size = (self.low + self.high) / 2, self.high - self.low
        angle = angle_of(self.keypoints[_PALM_WRIST], self.keypoints[_PALM_MIDDLE])
        box = Region(float(centre[0]), float(centre[1]), float(size[0]), float(size[1]), angle)
        return box.grow(_PALM_GROWTH, _PALM_SHIFT)


def anchors() -> np.ndarray:
    """Return (2016, 2) float64: centres of the detector's anchors in the unit square, x first.

    Row by row over each grid, with all anchors of a place next to each other. All are of size 1.
    """
    grids = []
    for cells, each in _GRIDS:
        middles = (np.arange(cells) + 0.5) / cells
        y, x = np.meshgrid(middles, middles, indexing="ij")
        grids.append(np.repeat(np.stack([x.ravel(), y.ravel()], axis=1), each, axis=0))
    return np.concatenate(grids)


def decode(values: np.ndarray, logits: np.ndarray, min_score: float) -> list[Palm]:
    """Decode the detector's output to palms in the unit square of its image, by anchor.

    `values` (2016, 18) are centre, size and seven keypoints, px of the detector's image, centre and
    keypoints relative to the anchor; `logits` (2016,) those of the scores.
    """
    scores = 1 / (1 + np.exp(-np.clip(logits.astype(np.float64), -100, 100)))
    kept = np.flatnonzero(scores >= min_score)
    points = values[kept].astype(np.float64).reshape(-1, PALM_VALUES // 2, 2) / PALM_EDGE
    size = points[:, 1]
    points = points + anchors()[kept][:, None]
    return [
        Palm(place[0] - half, place[0] + half, place[2:], float(score))
        for place, half, score in zip(points, size / 2, scores[kept], strict=True)
        if (half >= 0).all()
    ]


def suppress(palms: list[Palm]) -> list[Palm]:
    """Replace boxes of the same palm by their mean, weighted with their scores; best first.

    Each has the score of its best box. Source: MediaPipe's NonMaxSuppressionCalculator, algorithm
    WEIGHTED.
    """
    rest = sorted(palms, key=lambda palm: -palm.score)
    found = []
    while rest:
        best = rest[0]
        same = [
            palm
            for palm in rest
            if palm is best or _box_overlap(palm.low, palm.high, best.low, best.high) > _SAME_PALM
        ]
        rest = [palm for palm in rest if not any(palm is one for one in same)]
        weights = np.array([palm.score for palm in same])
        weights /= weights.sum()
        low, high, keypoints = (
            np.tensordot(weights, [getattr(palm, part) for palm in same], 1)
            for part in ("low", "high", "keypoints")
        )
        found.append(Palm(low, high, keypoints, best.score))
    return found


def palm_input(image: np.ndarray) -> np.ndarray:
    """Return the detector's image: all of an (H, W, 3) image, with black bands to a square."""
    square = full_square(image.shape[1], image.shape[0])
    return cut_region(image, square, PALM_EDGE, outside_black=True)


def place_in_image(palm: Palm, width: int, height: int) -> Palm:
    """Return a palm of the detector's unit square in pixels of the image."""
    square = full_square(width, height)
    low, high, keypoints = (
        to_image(part, square) for part in (palm.low, palm.high, palm.keypoints)
    )
    return Palm(low, high, keypoints, palm.score)


# --- Hands

#: Edge of the images that the network takes, px.
HAND_EDGE = 224
#: Landmarks that hardly move against each other; the next region is the box around them.
_STABLE = np.array([0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18])
_WRIST, _INDEX, _MIDDLE, _RING = 0, 5, 9, 13
#: From the box of the stable landmarks to the next region: scale, and shift to the fingers.
_GROWTH, _SHIFT = 2.0, -0.1
#: The network's depth is in another scale than its image.
_DEPTH = 0.4


@dataclass(frozen=True, eq=False)
class SeenHand:
    """One hand in one image."""

    #: (21, 3) float64, x, y in px of the image; z in the same unit, negative towards the camera,
    #: relative to the wrist.
    image: np.ndarray
    #: (21, 3) float64 m, x right, y down, z away from the camera; the origin is near the hand's
    #: centre.
    world: np.ndarray
    #: Probability that it is a hand.
    presence: float
    #: Probability that it is a right hand, if the video is not mirrored.
    right: float

    def next_region(self) -> Region:
        """Return the region in which this hand is looked for in the next image."""
        points = self.image[:, :2]
        fingers = ((points[_INDEX] + points[_RING]) / 2 + points[_MIDDLE]) / 2
        angle = angle_of(points[_WRIST], fingers)
        cos, sin = math.cos(angle), math.sin(angle)
        axes = np.array([[cos, -sin], [sin, cos]])  # columns: the region's axes
        turned = points[_STABLE] @ axes
        low, high = turned.min(axis=0), turned.max(axis=0)
        x, y = axes @ ((low + high) / 2)
        width, height = high - low
        box = Region(float(x), float(y), float(width), float(height), angle)
        return box.grow(_GROWTH, _SHIFT)

    def size(self) -> float:
        """Return the longer side of the box around all landmarks, px."""
        return float(np.ptp(self.image[:, :2], axis=0).max())

    def place_in(self, region: Region) -> SeenHand:
        """Move the network's output for a region, a square, into the image.

        The network's points are px of its own image, and its axes those of the region.
        """
        points = self.image.astype(np.float64) / HAND_EDGE
        flat = to_image(points[:, :2], region)
        depth = points[:, 2:] / _DEPTH * region.width
        cos, sin = math.cos(region.rotation), math.sin(region.rotation)
        world = self.world.astype(np.float64)
        turned = world[:, :2] @ np.array([[cos, -sin], [sin, cos]]).T
        return SeenHand(
            np.concatenate([flat, depth], axis=1),
            np.concatenate([turned, world[:, 2:]], axis=1),
            self.presence,
            self.right,
        )


# --- The files

#: Largest network that is read, bytes.
MAX_NETWORK = 64 * 1024 * 1024
#: Most members of an archive that is looked through.
_MAX_MEMBERS = 100_000
#: Bytes 4 to 8 of every TensorFlow Lite file.
_MAGIC = b"TFL3"


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


def models_folder() -> Path:
    """Return the folder of the cache in which the networks lie."""
    return cache_root() / "models" / "mediapipe-hands-0.10.21"


def load_models(model: Path | None = None, *, opener: Opener | None = None) -> HandModels:
    """Read the networks, downloading them when they are in none of the places."""
    where = models_folder() if model is None else model
    if model is None and not all((where / name).is_file() for name in (PALM, HAND)):
        fetch_models(opener=opener)
    pinned = model is None or where.suffix == ".whl"
    if where.is_dir():
        places = [os.fspath(where / name) for name in (PALM, HAND)]
        contents = [_read_file(Path(place)) for place in places]
    else:
        names = [MEMBERS[name].name for name in (PALM, HAND)] if pinned else TASK_MEMBERS
        places = [f"{where}: {name}" for name in names]
        contents = read_members(where, names)
    for name, content, place in zip((PALM, HAND), contents, places, strict=True):
        if pinned:
            _check(content, MEMBERS[name], place)
        if content[4:8] != _MAGIC:
            raise BadInput("does not hold a TensorFlow Lite network", where=place)
    return HandModels(contents[0], contents[1], os.fspath(where))


def fetch_models(*, opener: Opener | None = None, wheel: Pinned = WHEEL) -> Path:
    """Download the wheel and keep its networks and its licence in the cache's folder.

    Raises:
        HwpError: the wheel cannot be downloaded.
        BadInput: it has another content than the pinned one.
    """
    folder = models_folder()
    with disc_errors(tempfile.gettempdir()), tempfile.TemporaryFile() as stream:
        try:
            download(wheel, stream, opener)
        except NotAvailable as error:
            raise HwpError(
                f"{error.problem}, and the networks of the hand tracker are not in the cache",
                where=folder,
                remedy="On a machine with network run `hwp-bench data track --fetch` and copy "
                f"that folder to this place; or give --model a wheel that `{PIP}` has made.",
            ) from error
        kept = {}
        for name, member in MEMBERS.items():
            (content,) = read_members(stream, [member.name], where=wheel.name)
            _check(content, member, member.name)
            kept[name] = content
    for name, content in kept.items():
        atomic_write(folder / name, content)
    return folder


def read_members(
    archive: Path | IO[bytes], names: Sequence[str], *, where: str | None = None
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


def _read_file(path: Path) -> bytes:
    check_is_file(path, remedy=f"The folder must contain {PALM} and {HAND}.")
    if path.stat().st_size > MAX_NETWORK:
        raise BadInput(f"is larger than {MAX_NETWORK} bytes", where=path)
    return path.read_bytes()


def _check(content: bytes, expected: Pinned, where: str) -> None:
    digest = hashlib.sha256(content).hexdigest()
    if len(content) != expected.size or digest != expected.sha256:
        raise BadInput(
            f"has SHA-256 {digest[:16]} where {expected.sha256[:16]} is expected",
            where=where,
            remedy="It is damaged or was changed. Delete it and run the command again.",
        )


# --- The networks as functions of an image, run by LiteRT (the runtime of TensorFlow Lite)


class LiteRtNetworks:
    """MediaPipe's networks: they find palms, and the landmarks of a hand."""

    def __init__(self, models: HandModels) -> None:
        problem = "ai-edge-litert is not installed, which runs the networks of the hand tracker"
        runtime = import_extra("ai_edge_litert.interpreter", "track", problem)
        palm_outputs: list[tuple[int, ...]] = [(1, ANCHOR_COUNT, PALM_VALUES), (1, ANCHOR_COUNT, 1)]
        hand_outputs: list[tuple[int, ...]] = [(1, 63), (1, 1), (1, 1), (1, 63)]
        self._palm = _Network(runtime, models.palm, models.source, PALM_EDGE, palm_outputs)
        self._hand = _Network(runtime, models.hand, models.source, HAND_EDGE, hand_outputs)

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
    ) -> None:
        try:
            with _silent():
                self._run = runtime.Interpreter(model_content=content, num_threads=1)
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
    """Hide what the runtime itself writes to standard error."""
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
