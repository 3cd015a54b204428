"""A capture folder: opened and checked, images as they are read; written whole or not at all."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.base.arrays import write_npz
from hwp_bench.base.errors import (
    BadCapture,
    BadInput,
    HwpError,
    ShapeMismatch,
    UsageError,
    place,
    whole_number,
)
from hwp_bench.base.files import (
    atomic_folder,
    atomic_write,
    inside,
    read_json,
    refuse_existing,
    refuse_other,
    sha256_json,
    write_json,
)
from hwp_bench.base.images import pixel_digest, read_gray, read_rgb, write_image
from hwp_bench.capture.schema import (
    CAMERAS,
    EXTRA,
    FREE_VIEW,
    HANDS,
    IMAGE_FOLDERS,
    METADATA,
    RGB_KINDS,
    SIDES,
    TRUE_HANDS,
    TRUE_TEMPLATE,
    Cameras,
    CaptureInfo,
    HandModelId,
    arrays_digest,
    hand_arrays,
    image_path,
    numbers_digests,
    read_cameras,
    read_hands,
    read_subject_mesh,
    write_numbers,
)
from hwp_bench.hands.skeleton import Camera, HandParameters, HandPose, hand_poses
from hwp_bench.hands.sources import absolute_source, load_template

if TYPE_CHECKING:
    from hwp_bench.hands.template import HandTemplate


# Facts that a free-view clip shares with its capture.
_SHARED = ("hands", "width", "height")
_CONVERT = "Use the model that it was made with, or convert it: hwp-bench data convert."


@dataclass(repr=False, eq=False)
class Capture:
    """A capture on disk."""

    #: The folder.
    root: Path
    #: Its description, from `capture.json`.
    info: CaptureInfo
    #: Estimated hand parameters by side.
    hands: dict[str, HandParameters]
    #: One camera a frame.
    cameras: Cameras

    def __len__(self) -> int:
        return self.info.frame_count

    def __repr__(self) -> str:
        info = self.info
        hands = "both hands" if info.interacting else f"{info.hands} hand"
        named = ", ".join(info.perturbations) or "no perturbations"
        truth = ", clean frames known" if self.has_clean else ""
        return (
            f"<Capture {info.id!r}: {info.frame_count} frames of {info.width} x {info.height} px, "
            f"{hands} ({info.hand_model.name}), {named}{truth}>"
        )

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of every frame, px."""
        return self.info.height, self.info.width

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of the metadata and of the digests of every part.

        A copy that lacks its exact masks has another one: it is scored on the estimated masks.
        """
        return digest_at(self.root, self.info)

    @property
    def has_clean(self) -> bool:
        """Whether the clean version of every frame is known."""
        return (self.root / IMAGE_FOLDERS["clean"]).is_dir()

    @property
    def has_true_masks(self) -> bool:
        """Whether the exact visible-hand coverage is known."""
        return (self.root / IMAGE_FOLDERS["true_masks"]).is_dir()

    @property
    def lacks_masks(self) -> bool:
        """Whether the exact masks that belong to the capture are not there."""
        return "true_masks" in (self.info.digests or {}) and not self.has_true_masks

    @cached_property
    def true_hands(self) -> dict[str, HandParameters] | None:
        """True hand parameters by side, where they are known."""
        path = self.root / TRUE_HANDS
        if not path.is_file():
            return None
        return read_hands(path, self.info.sides, self.info.frame_count)

    @cached_property
    def free_view(self) -> Capture | None:
        """The free-view clip: unseen poses from cameras all around; None where there is none.

        Its digest is not a part of this capture's.

        Raises:
            BadCapture, BadInput: it is damaged, or belongs to another capture.
        """
        folder = self.root / FREE_VIEW
        if not (folder / METADATA).is_file():
            return None
        clip, model = open_capture(folder), self.info.hand_model
        same = {name: getattr(clip.info, name) == getattr(self.info, name) for name in _SHARED}
        same["hand_model"] = clip.info.hand_model.digest == model.digest
        for name, equal in same.items():
            if not equal:
                raise BadCapture(
                    "is not that of the capture around it",
                    where=folder / METADATA,
                    field=name,
                    remedy="Remove the folder, or render the capture again.",
                )
        return clip

    def frame(self, frame: int) -> np.ndarray:
        """Read one frame: (H, W, 3) uint8 sRGB.

        Raises:
            BadImage: missing, damaged or of another size.
            UsageError: the capture has no such frame.
        """
        return self.image("frames", frame)

    def mask(self, frame: int) -> np.ndarray:
        """Read the visible-hand mask that methods are given: (H, W) uint8, 255 = hand."""
        return self.image("masks", frame)

    def clean(self, frame: int) -> np.ndarray:
        """Read the clean version of a frame: (H, W, 3) uint8 sRGB."""
        return self.image("clean", frame)

    def true_mask(self, frame: int) -> np.ndarray:
        """Read the exact coverage of visible hand: (H, W) uint8, 255 = covered fully."""
        return self.image("true_masks", frame)

    def clean_mask(self, frame: int) -> np.ndarray:
        """Read the visible hand of the clean frame: (H, W) uint8, 255 = covered fully."""
        return self.image("clean_masks", frame)

    def image(self, kind: str, frame: int) -> np.ndarray:
        """Read an image of a kind, a key of `IMAGE_FOLDERS`; other arguments as of `frame`."""
        path = image_path(self.root, kind, self._check(frame))
        return (read_rgb if kind in RGB_KINDS else read_gray)(path, self.size)

    def hand_poses(self, frame: int) -> dict[str, HandPose]:
        """Return the estimated parameters of every hand in one frame, by side."""
        return hand_poses(self.hands, self._check(frame))

    def camera(self, frame: int) -> Camera:
        """Return the camera of one frame."""
        return self.cameras.camera(self._check(frame), self.info.width, self.info.height)

    def template(self, side: str) -> HandTemplate:
        """Load the hand template of one side, to which the parameters belong.

        Raises:
            UsageError: the capture has no such hand.
            BadInput: the template that is installed here is another than the capture's.
        """
        if side not in self.info.sides:
            raise UsageError(f"this capture has no {side} hand", where=self.root)
        return load_matching_template(self.info.hand_model, self.info.sides, side, where=self.root)

    @property
    def has_true_template(self) -> bool:
        """Whether the subject's own hands at rest are known."""
        return (self.root / TRUE_TEMPLATE).is_file()

    def true_template(self, side: str) -> HandTemplate:
        """Read the subject's own hand at rest, which no shape parameter changes.

        Raises:
            UsageError: the capture has no such hand.
            BadInput: it is missing or damaged, or does not belong to the hand model.
        """
        return read_subject_mesh(self.root / TRUE_TEMPLATE, self.template(side))

    def scoring_mask(self, frame: int) -> tuple[np.ndarray, bool]:
        """Read the mask that scores are taken over, (H, W) uint8, and whether it is exact."""
        if self.has_true_masks:
            return self.true_mask(frame), True
        return self.mask(frame), False

    def _check(self, frame: int) -> int:
        frame = whole_number(frame, "frame")
        if not 0 <= frame < self.info.frame_count:
            raise UsageError(
                f"there is no frame {frame}, only 0 to {self.info.frame_count - 1}", where=self.root
            )
        return frame


def digest_at(root: Path, info: CaptureInfo) -> str:
    """Return the digest of the capture in a folder, as `Capture.digest`."""
    whole = info.to_json()
    lacking = "true_masks" in whole["digests"] and not (root / IMAGE_FOLDERS["true_masks"]).is_dir()
    return sha256_json({"capture": whole, "masks": "estimated"} if lacking else whole)


def open_capture(path: str | os.PathLike[str]) -> Capture:
    """Open the folder that holds `capture.json`; images are read and checked when asked for.

    Raises:
        BadCapture: not a capture folder, or its metadata is wrong; file and field are named.
        BadInput: hand parameters or cameras are damaged, not finite, or of another length.
        UsageError: it is not a path.
    """
    root = place(path, "path")
    if not (root / METADATA).is_file():
        raise BadCapture(
            f"is not a capture: it has no {METADATA}",
            where=root,
            remedy="Give the folder of one capture.",
        )
    metadata = root / METADATA
    info = CaptureInfo.from_json(read_json(metadata), where=os.fspath(metadata))
    return Capture(
        root,
        info,
        hands=read_hands(root / HANDS, info.sides, info.frame_count),
        cameras=read_cameras(root / CAMERAS, info.frame_count),
    )


def identify_hand_model(source: str, hands: str) -> HandModelId:
    """Say which hand model the parameters of a capture belong to, as its reader compares it.

    `source` is the model, as `load_template` takes it; `hands` are `right`, `left` or `both`.
    """
    first = load_template(source, SIDES[hands][0])
    return HandModelId(first.name, first.digest, absolute_source(source))


def load_matching_template(
    model: HandModelId, sides: Sequence[str], side: str, *, where: str | os.PathLike[str]
) -> HandTemplate:
    """Load the template of one side of the model that parameters were made with."""
    first = load_template(model.source, sides[0])
    if first.name != model.name:
        raise BadInput(
            f"belongs to hand model {model.name}, and {model.source!r} is {first.name} here",
            where=where,
            field="hand_model.name",
            remedy=_CONVERT,
        )
    if first.digest != model.digest:
        other = "left" if sides[0] == "right" else "right"
        try:
            exchanged = model.digest == load_template(model.source, other).digest
        except HwpError:  # it cannot be loaded here
            exchanged = False
        if exchanged:
            raise BadCapture(
                f"is the digest of the {other} hand of {model.name}; the capture's first hand is "
                f"the {sides[0]} one",
                where=where,
                field="hand_model.digest",
                remedy=f"Import it again; or, where it has the right hands, write {first.digest} "
                "there.",
            )
        raise BadInput(
            f"belongs to another edition of hand model {model.name} ({model.digest[:12]}) than "
            f"{model.source!r} here ({first.digest[:12]})",
            where=where,
            field="hand_model.digest",
            remedy=_CONVERT,
        )
    return first if side == sides[0] else load_template(model.source, side)


def refuse_no_capture(path: str | os.PathLike[str]) -> None:
    """Refuse the place of a capture where something else is."""
    refuse_other(path, "a capture", lambda folder: (folder / METADATA).is_file())


def refuse_taken(path: str | os.PathLike[str], *, overwrite: bool) -> None:
    """Refuse the place of a capture before minutes of work: something else, or an existing one."""
    refuse_no_capture(path)
    refuse_existing(path, overwrite=overwrite, flag="--overwrite")


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
        overwrite: replace an existing capture.

    Raises:
        UsageError: the folder exists, or holds something else than a capture.
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
        refuse_no_capture(path)
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
        write_numbers(self._root, self._hands, self._cameras)
        digests |= numbers_digests(self._hands, self._cameras)
        if self._true_hands is not None:
            arrays = hand_arrays(self._true_hands)
            write_npz(self._root / TRUE_HANDS, arrays)
            digests["true_hands"] = arrays_digest(arrays)
        info = replace(self.info, digests=dict(sorted(digests.items())))
        write_json(self._root / METADATA, info.to_json())


def rewrite_capture(
    capture: Capture,
    out: str | os.PathLike[str],
    info: CaptureInfo,
    hands: Mapping[str, HandParameters],
    *,
    free_view: tuple[Capture, CaptureInfo, Mapping[str, HandParameters]] | None = None,
    overwrite: bool = False,
) -> None:
    """Copy a capture with other hands, and in it a free-view clip with other hands.

    True hands are left out: they are of the old model.
    """
    with CaptureWriter(out, info, hands, capture.cameras, overwrite=overwrite) as writer:
        kinds = [kind for kind, name in IMAGE_FOLDERS.items() if (capture.root / name).is_dir()]
        for frame in range(len(capture)):
            for kind in kinds:
                writer.image(kind, frame, capture.image(kind, frame))
        if free_view is not None:
            clip, clip_info, clip_hands = free_view
            rewrite_capture(clip, writer.folder / FREE_VIEW, clip_info, clip_hands)


def combine(digests: Iterable[str]) -> str:
    """Return one digest (hex) of the images of a clip, in frame order."""
    total = hashlib.sha256()
    for digest in digests:
        total.update(bytes.fromhex(digest))
    return total.hexdigest()
