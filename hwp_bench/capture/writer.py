"""Write a capture folder: it is complete at the end, or it does not exist."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType

import numpy as np

from hwp_bench.base.errors import BadCapture, ShapeMismatch
from hwp_bench.base.files import atomic_folder, atomic_write, inside, write_json
from hwp_bench.base.images import pixel_digest, write_image
from hwp_bench.capture.reader import Capture
from hwp_bench.capture.schema import (
    CAMERAS,
    EXTRA,
    HANDS,
    METADATA,
    RGB_KINDS,
    TRUE_HANDS,
    Cameras,
    CaptureInfo,
    arrays_digest,
    hand_arrays,
    image_path,
    numbers_digests,
    write_cameras,
    write_hands,
)
from hwp_bench.hands.skeleton import HandParameters


class CaptureWriter:
    """A context manager that fills a capture folder.

    Frames may come in any order, and from several threads. When the block ends well every frame
    must have been given; the folder then takes its name. When it ends with an error nothing is
    left.

    Args:
        path: the capture folder to make.
        info: description of the capture; digests are filled in.
        hands: parameters by side, as a method is given them.
        cameras: one camera a frame.
        overwrite: replace an existing folder.

    Raises:
        UsageError: the folder exists.
        BadCapture: parameters, cameras and `info` contradict each other.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        info: CaptureInfo,
        hands: Mapping[str, HandParameters],
        cameras: Cameras,
        *,
        overwrite: bool = False,
    ) -> None:
        self.path = Path(path)
        self.info = CaptureInfo.from_json(info.to_json(), where=os.fspath(path))
        self._check_hands(hands)
        if len(cameras) != info.frame_count:
            raise BadCapture(
                f"{len(cameras)} cameras for {info.frame_count} frames", where=path, field="cameras"
            )
        self._hands = dict(hands)
        self._cameras = cameras
        self._true_hands: dict[str, HandParameters] | None = None
        self._digests: dict[str, dict[int, str]] = {}
        self._stack = contextlib.ExitStack()
        self._overwrite = overwrite

    def __enter__(self) -> CaptureWriter:
        self._root = self._stack.enter_context(atomic_folder(self.path, overwrite=self._overwrite))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is None:
            try:
                self._finish()
            except BaseException as failure:
                self._stack.__exit__(type(failure), failure, failure.__traceback__)
                raise
        self._stack.__exit__(kind, error, traceback)

    def frame(self, frame: int, rgb: np.ndarray) -> None:
        """Store one frame: (H, W, 3) uint8 sRGB."""
        self.image("frames", frame, rgb)

    def mask(self, frame: int, coverage: np.ndarray) -> None:
        """Store the visible-hand mask that methods are given: (H, W) uint8, 255 = hand."""
        self.image("masks", frame, coverage)

    def clean(self, frame: int, rgb: np.ndarray) -> None:
        """Store the frame without any perturbation (truth): (H, W, 3) uint8 sRGB."""
        self.image("clean", frame, rgb)

    def true_mask(self, frame: int, coverage: np.ndarray) -> None:
        """Store the exact coverage of visible hand (truth): (H, W) uint8, 255 = covered fully."""
        self.image("true_masks", frame, coverage)

    def clean_mask(self, frame: int, coverage: np.ndarray) -> None:
        """Store the visible hand of the clean frame (truth): (H, W) uint8, 255 = all hand."""
        self.image("clean_masks", frame, coverage)

    def true_hands(self, hands: Mapping[str, HandParameters]) -> None:
        """Store the true hand parameters by side."""
        self._check_hands(hands)
        self._true_hands = dict(hands)

    @property
    def folder(self) -> Path:
        """The folder while it is filled, under its temporary name; for a clip inside of it."""
        return self._root

    def extra(self, name: str, data: bytes | str) -> None:
        """Store a further file under `extra/`."""
        folder = self._root / EXTRA
        folder.mkdir(exist_ok=True)
        atomic_write(inside(folder, name), data)

    def image(self, kind: str, frame: int, pixels: np.ndarray) -> None:
        """Store an image of a kind, a key of `IMAGE_FOLDERS`."""
        channels = (3,) if kind in RGB_KINDS else ()
        expected = (self.info.height, self.info.width, *channels)
        if pixels.shape != expected or pixels.dtype != np.uint8:
            raise ShapeMismatch(
                f"is {pixels.dtype} {pixels.shape} where uint8 {expected} is expected",
                where=self.path,
                field=f"{kind}[{frame}]",
            )
        if not 0 <= frame < self.info.frame_count:
            said = f"frame {frame} is not among the {self.info.frame_count} frames"
            raise BadCapture(said, where=self.path, field=kind)
        write_image(image_path(self._root, kind, frame), pixels)
        self._digests.setdefault(kind, {})[frame] = pixel_digest(pixels)

    def _check_hands(self, hands: Mapping[str, HandParameters]) -> None:
        if set(hands) != set(self.info.sides):
            said = f"parameters of {sorted(hands)} for a capture of {list(self.info.sides)}"
            raise BadCapture(said, where=self.path, field="hands")
        for side, parameters in hands.items():
            if len(parameters.pose) != self.info.frame_count:
                said = f"{len(parameters.pose)} poses for {self.info.frame_count} frames"
                raise BadCapture(said, where=self.path, field=f"hands.{side}")

    def _finish(self) -> None:
        count = self.info.frame_count
        for kind in {"frames", "masks", *self._digests}:
            missing = set(range(count)) - set(self._digests.get(kind, {}))
            if missing:
                said = f"{len(missing)} of {count} images were not given (first: {min(missing)})"
                raise BadCapture(said, where=self.path, field=kind)
        digests = {
            kind: combine(by_frame[frame] for frame in range(count))
            for kind, by_frame in self._digests.items()
        }
        write_hands(self._root / HANDS, self._hands)
        write_cameras(self._root / CAMERAS, self._cameras)
        digests |= numbers_digests(self._hands, self._cameras)
        if self._true_hands is not None:
            write_hands(self._root / TRUE_HANDS, self._true_hands)
            digests["true_hands"] = arrays_digest(hand_arrays(self._true_hands))
        info = replace(self.info, digests=dict(sorted(digests.items())))
        write_json(self._root / METADATA, info.to_json())


def rewrite_capture(
    capture: Capture,
    out: str | os.PathLike[str],
    info: CaptureInfo,
    hands: Mapping[str, HandParameters],
    *,
    overwrite: bool = False,
) -> None:
    """Copy a capture with other hands. True hands are left out: they are of the old model."""
    with CaptureWriter(out, info, hands, capture.cameras, overwrite=overwrite) as writer:
        kinds = ["frames", "masks", *["true_masks"] * capture.has_true_masks]
        kinds += ["clean", "clean_masks"] * capture.has_clean
        for frame in range(len(capture)):
            for kind in kinds:
                writer.image(kind, frame, capture.image(kind, frame))


def combine(digests: Iterable[str]) -> str:
    """Return one digest (hex) of the images of a clip, in frame order."""
    total = hashlib.sha256()
    for digest in digests:
        total.update(bytes.fromhex(digest))
    return total.hexdigest()
