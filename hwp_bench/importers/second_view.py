"""Real novel views: what a second camera saw becomes the free-view clip of a capture.

Both cameras film the same hands at the same time, and each has a capture of its own, which brings
its pixels, its masks and where it saw the hands. Captures of a data set share one world. Those of
two videos do not: each is in the axes of its own camera and has the scale that its import gave
the hands. A calibration says where the cameras are; the scale, and where the hands are along each
ray, follow from both pictures.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from msgspec import Meta

from hwp_bench.base.arrays import evenly
from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.files import read_bounded, refuse_existing
from hwp_bench.base.records import parse_record, parse_toml, without_schema
from hwp_bench.capture import Cameras, Capture, CaptureWriter
from hwp_bench.capture.schema import FREE_VIEW, MAX_FRAMES, MAX_ID, check_cameras
from hwp_bench.hands import HandParameters, project
from hwp_bench.hands.skinning import pose_parameters
from hwp_bench.importers.shared.frames import CropWindows
from hwp_bench.metrics.pixels import can_be_scored

#: Version of the calibration files, and their largest size in bytes.
SCHEMA, MAX_BYTES = "hwp-two-cameras/1", 100_000
#: Most frames of a clip.
MOST = 24
#: What `source.kind` of a clip says.
KIND = "second camera"
#: A clip is refused where the hands of one camera miss those of the other by more than this share
#: of their size: another calibration, another offset, other hands.
FAILED = 0.15
# Largest difference of two frame rates that are taken for one, as a share.
_SAME_RATE = 0.01
# Distance from which on landmarks that disagree pull less, px; most steps: sound pairs take ten.
_ROBUST, _STEPS = 2.0, 50

_Matrix3 = Annotated[list[list[float]], Meta(min_length=3, max_length=3)]
_Matrix4 = Annotated[list[list[float]], Meta(min_length=4, max_length=4)]


@dataclass(frozen=True)
class TwoCameras:
    """The calibration of two cameras without distortion, OpenCV axes."""

    #: Intrinsics of whole frames, 3 x 3 px: of the capture's camera, and of the second one.
    first: _Matrix3
    second: _Matrix3
    #: From the axes of the first camera to those of the second, 4 x 4, m.
    motion: _Matrix4
    #: Frame of the second video at the time of frame 0 of the first.
    offset: Annotated[int, Meta(ge=-MAX_FRAMES, le=MAX_FRAMES)] = 0


def read_calibration(path: Path) -> TwoCameras:
    """Read a calibration file.

    Raises:
        BadInput: a field is missing or wrong, or a matrix is not a camera's.
    """
    try:
        text = read_bounded(path, MAX_BYTES).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput("cannot be read", where=path) from error
    value = without_schema(parse_toml(text, where=path), SCHEMA, where=path)
    found = parse_record(TwoCameras, value, where=path, error=BadInput)
    K, still = np.eye(3)[None], np.eye(4)[None]
    for name in ("first", "second", "motion"):
        try:
            matrix = np.array([getattr(found, name)])
        except ValueError as error:
            raise BadInput("has rows of several lengths", where=path, field=name) from error
        camera = (K, matrix) if name == "motion" else (matrix, still)
        try:
            check_cameras(*camera, where=os.fspath(path))
        except BadInput as error:
            said = error.problem.removeprefix("frame 0 ")
            raise BadInput(said, where=path, field=name) from error
    return found


@dataclass(frozen=True)
class SecondView:
    """The outcome of importing a second camera."""

    #: Frames of the clip: their numbers in the capture, and in that of the second camera.
    frames: list[int]
    second_frames: list[int]
    #: True metres of a metre of the capture; None where both captures share a world.
    scale: float | None
    #: Mean distance of the hands' landmarks from where the second camera saw them, px.
    distance_px: float


def add_second_view(
    first: Capture,
    second: Capture,
    calibration: TwoCameras | None = None,
    *,
    overwrite: bool = False,
) -> SecondView:
    """Make the free-view clip of a capture of what a second camera saw at the same time.

    The clip has the hands of the first capture, because an avatar is drawn in these poses, and
    frames and masks of the second. With a calibration a hand is moved to where both cameras see
    it.

    Args:
        first: the capture that gets the clip, in a folder of its own inside it.
        second: the capture of the second camera.
        calibration: of captures of two videos; None for captures that share a world.
        overwrite: replace a clip that is there.

    Raises:
        UsageError: there is a clip, or the captures do not go together.
        BadInput: what the cameras saw contradicts the calibration.
    """
    refuse_existing(first.root / FREE_VIEW, overwrite=overwrite, flag="--overwrite")
    of_videos = [c.root for c in (first, second) if c.info.source.get("kind") == "video"]
    if calibration is None and of_videos:
        raise UsageError(
            "captures of videos share no world",
            where=of_videos[0],
            field="--calibration",
            remedy="Say where both cameras are with --calibration; docs/video.md describes it.",
        )
    if _pictures(first) & _pictures(second):
        raise UsageError(
            f"shows the pictures of {first.root}",
            where=second.root,
            remedy="Name a capture of another camera.",
        )
    for name in ("hands", "width", "height"):
        values = [getattr(capture.info, name) for capture in (first, second)]
        if values[0] != values[1]:
            said = f"{name} is {values[1]}, of {first.root} {values[0]}"
            raise UsageError(said, where=second.root, remedy="Import both with the same choices.")
    rates = [_rate(capture) for capture in (first, second)]
    if abs(rates[0] - rates[1]) > _SAME_RATE * max(rates):
        raise UsageError(
            f"has {rates[1]:.4g} frames per second, {first.root} {rates[0]:.4g}",
            where=second.root,
            remedy="Frames are paired by their numbers: convert one video to the rate of the "
            "other, track and import it again.",
        )
    offset = 0 if calibration is None else calibration.offset
    rows, others = _common_frames(first, second, offset)
    hands, cameras = _hands_of(first, rows), _cameras_of(second, others)
    seen = _pixels(_landmarks(second, _hands_of(second, others)), cameras)
    scale = None
    if calibration is not None:
        points, own = _landmarks(first, hands), _cameras_of(first, rows)
        # What the imports took for the cameras is replaced, and what they saw stays.
        before, scene = _pixels(points, own), (hands, own, points)
        Ks = _cropped(first, rows, calibration.first), _cropped(second, others, calibration.second)
        motion = np.array(calibration.motion)
        hands, cameras, scale = _join(*scene, (before, seen), Ks, motion)
    drawn = _pixels(_landmarks(first, hands), cameras)
    distance = float(np.linalg.norm(drawn - seen, axis=-1).mean())
    size = float(np.linalg.norm(np.ptp(seen, axis=1), axis=-1).mean())
    if distance > FAILED * size:
        raise BadInput(
            f"sees the hands {distance:.0f} px from where the first camera has them, which is "
            f"{distance / size:.0%} of their size",
            where=second.root,
            remedy="Check the calibration, its axes (OpenCV, first to second camera) and offset.",
        )
    made = SecondView(rows.tolist(), others.tolist(), scale, round(distance, 3))
    info = replace(
        first.info,
        id=f"{first.info.id[: MAX_ID - len(FREE_VIEW) - 1]}-{FREE_VIEW}",
        device=second.info.device,
        licence=second.info.licence,
        frame_count=len(rows),
        # The frames of the clip are apart: their times are those of `at_frames`.
        times=None,
        perturbations={},
        source={
            "kind": KIND,
            "capture": second.info.id,
            "digest": second.digest,
            "frames": made.second_frames,
            "at_frames": made.frames,
            "scale": scale,
            "distance_px": made.distance_px,
        },
        digests=None,
    )
    folder = first.root / FREE_VIEW
    with CaptureWriter(folder, info, hands, cameras, overwrite=overwrite) as writer:
        for frame, other in enumerate(others.tolist()):
            for kind in ("frames", "masks", *["true_masks"] * second.has_true_masks):
                writer.image(kind, frame, second.image(kind, other))
    return made


def _hands_of(capture: Capture, rows: np.ndarray) -> dict[str, HandParameters]:
    return {
        side: replace(hand, pose=hand.pose[rows], transl=hand.transl[rows], valid=hand.valid[rows])
        for side, hand in capture.hands.items()
    }


def _cameras_of(capture: Capture, rows: np.ndarray) -> Cameras:
    return Cameras(capture.cameras.Ks[rows], capture.cameras.viewmats[rows])


def _landmarks(capture: Capture, hands: Mapping[str, HandParameters]) -> torch.Tensor:
    """Landmarks of the hands of a capture in the world, (F, 21 or 42, 3) m."""
    posed = [pose_parameters(capture.template(side), hand) for side, hand in hands.items()]
    return torch.cat([one.landmarks for one in posed], dim=1)


def _pixels(points: torch.Tensor, cameras: Cameras) -> np.ndarray:
    viewmats, Ks = torch.from_numpy(cameras.viewmats), torch.from_numpy(cameras.Ks)
    return project(points, viewmats, Ks)[0].numpy()


def _common_frames(first: Capture, second: Capture, offset: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames of both captures at the same times in which both have every hand, evenly chosen.

    Those of the second can be scored.
    """
    at = {time - offset: frame for frame, time in enumerate(_times(second))}
    pairs = [(frame, at[time]) for frame, time in enumerate(_times(first)) if time in at]
    pairs = [
        (one, other)
        for one, other in pairs
        if all(hand.valid[one] for hand in first.hands.values())
        and all(hand.valid[other] for hand in second.hands.values())
        and can_be_scored(*second.scoring_mask(other))
    ]
    if not pairs:
        raise UsageError(
            f"has no frame at the time of one of {first.root} in which both have every hand",
            where=second.root,
            remedy="Import both with frames of the same times: --range, --stride, the offset.",
        )
    rows, others = np.array(pairs)[evenly(len(pairs), MOST)].T
    return rows, others


def _times(capture: Capture) -> list[int]:
    """The number of each frame in its video or data set."""
    frames = capture.info.source.get("frames")
    if not isinstance(frames, list) or len(frames) != len(capture):
        return list(range(len(capture)))
    return frames if all(isinstance(one, int) for one in frames) else list(range(len(frames)))


def _pictures(capture: Capture) -> set[str]:
    """Digests of its frames, and of its video where it is of one."""
    video, frames = capture.info.source.get("video"), (capture.info.digests or {}).get("frames")
    known = [frames, video.get("sha256") if isinstance(video, dict) else None]
    return {str(digest) for digest in known if digest}


def _rate(capture: Capture) -> float:
    """Frames per second of its whole video or data set, on average."""
    numbers, times = _times(capture), capture.info.frame_times()
    return (numbers[-1] - numbers[0]) / times[-1] if len(times) > 1 else capture.info.fps


def _cropped(capture: Capture, rows: np.ndarray, K: list[list[float]]) -> np.ndarray:
    """Intrinsics (F, 3, 3) px of a capture's frames, from those of the whole frames."""
    crop = capture.info.source.get("crop")
    try:
        corners = np.array(crop["corners"], dtype=np.float64)[rows]  # type: ignore[index]
        windows = CropWindows(corners, int(crop["side"]), capture.info.width)  # type: ignore[index]
        return windows.intrinsics(np.array(K))
    except (KeyError, IndexError, TypeError, ValueError, ZeroDivisionError) as error:
        raise UsageError(
            "does not say how its frames were cropped from a video",
            where=capture.root,
            field="source.crop",
            remedy="A calibration is for captures of `hwp-bench data import video`.",
        ) from error


def _join(
    hands: dict[str, HandParameters],
    world: Cameras,
    points: torch.Tensor,
    seen: tuple[np.ndarray, np.ndarray],
    Ks: tuple[np.ndarray, np.ndarray],
    motion: np.ndarray,
) -> tuple[dict[str, HandParameters], Cameras, float]:
    """Find the scale of a capture, and move its hands to where both cameras see them.

    Least squares over the scale and one shift a hand and frame, of the landmarks' distances in
    both images. One picture cannot distinguish a small hand from a distant one. So an import is
    right except for its scale, and its error is largest along the ray.

    Args:
        hands: of the first capture, in its world; `points` (F, P, 3) m are their landmarks.
        world: cameras of the first capture.
        seen: (F, P, 2) px each, where the cameras saw the landmarks.
        Ks: (F, 3, 3) px each, intrinsics of their frames.
        motion: (4, 4) m, from the first camera's axes to the second's.

    Returns:
        The hands, the second camera in the first capture's world, and the scale.
    """
    # Imported here: it takes half a second, which every other import would wait for.
    from scipy.optimize import least_squares

    turns = world.viewmats[:, :3, :3]
    local = np.einsum("fij,fpj->fpi", turns, points.numpy()) + world.viewmats[:, None, :3, 3]
    shape = (len(local), len(hands), 1, 3)

    def moved(shifts: np.ndarray) -> np.ndarray:
        apart = local.reshape(len(local), len(hands), -1, 3) + shifts.reshape(shape)
        return np.asarray(apart.reshape(local.shape))

    def residual(values: np.ndarray) -> np.ndarray:
        here = moved(values[1:])
        there = here @ motion[:3, :3].T + motion[:3, 3] * np.exp(-values[0])
        errors = []
        for where, K, target in zip((here, there), Ks, seen, strict=True):
            flat = np.einsum("fij,fpj->fpi", K, where)
            errors.append(flat[..., :2] / np.maximum(flat[..., 2:], 1e-3) - target)
        return np.concatenate(errors).ravel()

    start = np.zeros(1 + int(np.prod(shape)))
    # By LSMR: the threads of a dense decomposition wait for each other on a busy machine.
    options = {"tr_solver": "lsmr", "loss": "soft_l1", "f_scale": _ROBUST, "max_nfev": _STEPS}
    found = least_squares(residual, start, **options).x
    shifts = np.einsum("fji,fsj->fsi", turns, found[1:].reshape(len(local), len(hands), 3))
    placed = {
        side: replace(hand, transl=hand.transl + shifts[:, number])
        for number, (side, hand) in enumerate(hands.items())
    }
    scale = float(np.exp(found[0]))
    scaled = motion.copy()
    scaled[:3, 3] /= scale
    return placed, Cameras(Ks[1], scaled @ world.viewmats), scale
