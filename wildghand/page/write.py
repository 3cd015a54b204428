"""Writes the page of an avatar: its poses, data, scripts and styles in one file."""

from __future__ import annotations

import base64
import dataclasses
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch

from hwp_bench.base.arrays import evenly
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write, refuse_existing_file
from hwp_bench.base.images import sample
from hwp_bench.capture import Capture
from hwp_bench.hands import anatomical_limits, load_template, pose_from_joint_angles
from hwp_bench.methods.contract import Camera, HandPose
from hwp_bench.report.page import render_template
from wildghand.avatar import WildGHandAvatar, load_avatar
from wildghand.avatar.avatar import InlinePicture
from wildghand.avatar.render import shown_sides
from wildghand.avatar.studio import REST, Pose
from wildghand.export.splats import turned
from wildghand.page.bake import (
    biases_content,
    hand_content,
    light_content,
    network_content,
    pack,
)
from wildghand.visibility.count import seen_anchors

if TYPE_CHECKING:
    from markupsafe import Markup


@dataclass(frozen=True)
class PageSettings:
    """How much of the avatar a page holds."""

    #: Poses of the clip, and random ones within the limits of the joints, from which is learnt what
    #: only follows from the pose.
    clip_samples: int = 80
    random_samples: int = 48
    #: Principal components of what a network says that is too large for a page.
    rank: int = 16
    #: Most training frames whose motion is played.
    most_frames: int = 240
    #: Edge of the still image for browsers without WebGL2, px.
    still_size: int = 384
    #: Of the random poses.
    seed: int = 0


# Turns of the hand, in degrees, and frames of the clip whose poses are tried, among which the start
# of a page is sought; the picture in which it is judged, px.
_TURNS, _TRIED, _JUDGED = range(0, 360, 30), 24, 128


@dataclass(frozen=True, eq=False)
class PoseSamples:
    """Poses of an avatar's hands."""

    #: (P, 16, 3) rad by side: the pose at the start, poses of the clip, random ones.
    learnt: Mapping[str, np.ndarray]
    #: The hands when the page is opened.
    start: Mapping[str, HandPose]
    #: Frames that are played, and (F, 51) their poses and translations by side.
    frames: list[int]
    motion: Mapping[str, np.ndarray]
    #: (4, 4) of the camera.
    viewmat: np.ndarray
    #: (F,) s, for how long each of them is shown.
    shown: np.ndarray


def sample_poses(
    avatar: WildGHandAvatar, capture: Capture | None, settings: PageSettings
) -> PoseSamples:
    """Choose poses."""
    random = np.random.default_rng(settings.seed)
    motion = {side: np.zeros((0, 51)) for side in avatar.sides}
    frames, viewmat, lasts = list[int](), np.eye(4), np.zeros(0)
    if capture is None:
        start = best_start(avatar)
        clip = {side: start[side].pose[None] for side in avatar.sides}
    else:
        _check(avatar, capture)
        fitted = _fitted(avatar, capture)
        frames = [fitted[pick] for pick in evenly(len(fitted), settings.most_frames)]
        drawn = [fitted[pick] for pick in evenly(len(fitted), settings.clip_samples)]
        poses = {f: avatar.believed(capture.hand_poses(f)) for f in fitted}
        start, viewmat = start_of_clip(avatar, capture), capture.camera(fitted[0]).viewmat
        if not np.array_equal(viewmat[:3, :3], np.eye(3)):
            # The studio's camera looks along z, the clip's does not.
            start = turned(avatar, start, viewmat[:3, :3].T, np.zeros(3))
        clip = {
            side: np.stack([start[side].pose, *(poses[frame][side].pose for frame in drawn)])
            for side in avatar.sides
        }
        for side in avatar.sides:
            hands = [poses[frame][side] for frame in frames]
            motion[side] = np.stack([np.append(hand.pose.ravel(), hand.transl) for hand in hands])
        times = capture.info.frame_times()[frames]
        lasts = np.diff(times, append=times[-1] + 1.0 / capture.info.fps)
    learnt = {
        side: np.concatenate([poses, _random(avatar, side, poses, settings.random_samples, random)])
        for side, poses in clip.items()
    }
    return PoseSamples(learnt, start, frames, motion, viewmat, lasts)


@torch.no_grad()
def best_start(
    avatar: WildGHandAvatar, tried: Sequence[Mapping[str, HandPose]] = ()
) -> dict[str, HandPose]:
    """Hands in the studio, lit as in the frames.

    Of the poses of fingers that are tried, or else at rest, in each turn, it is the one with most
    skin to the camera that frames show well, less the skin that they do not. A clip shows a hand in
    its own poses only: at rest the insides of fingers that are always bent would be blotches.
    """
    studio, visibility, rigs = avatar.studio, avatar.model.visibility, avatar.model.rigs
    if visibility is None:
        return studio.posed()
    camera = studio.camera(_JUDGED, _JUDGED)
    viewmat, K = (torch.as_tensor(m, dtype=torch.float32)[None] for m in (camera.viewmat, camera.K))

    def shown(hands: Mapping[str, HandPose]) -> float:
        anchors = {s: rigs[s].pose(*given) for s, given in avatar.posed(hands).items()}
        like = next(iter(anchors.values())).positions
        seen = seen_anchors(anchors, viewmat.to(like), K.to(like), torch.Size([_JUDGED] * 2))
        return sum(
            float((facing[0] * (2.0 * visibility.shown(side) - 1.0)).sum())
            for side, (_, facing) in seen.items()
        )

    rest: dict[str, Pose] = dict.fromkeys(avatar.sides, REST)
    of_clip: list[dict[str, Pose]] = [
        {side: hands[side].pose[1:] for side in avatar.sides} for hands in tried
    ]
    turned = (studio.posed_each(poses, turn) for poses in of_clip or [rest] for turn in _TURNS)
    return max(turned, key=shown)


def start_of_clip(avatar: WildGHandAvatar, capture: Capture) -> dict[str, HandPose]:
    """Hands in the studio in the pose of the clip that `best_start` finds."""
    fitted = _fitted(avatar, capture)
    tried = [fitted[pick] for pick in evenly(len(fitted), _TRIED)]
    return best_start(avatar, [avatar.believed(capture.hand_poses(frame)) for frame in tried])


def hand_controls(avatar: WildGHandAvatar, side: str) -> dict[str, Any]:
    """Axes and ranges (degrees) of the 15 finger joints, for the page's sliders."""
    limits = anatomical_limits(load_template(avatar.hand_model.source, side))
    return {
        "axes": limits.axes.tolist(),
        "lower": np.rad2deg(limits.lower).round(1).tolist(),
        "upper": np.rad2deg(limits.upper).round(1).tolist(),
    }


def _random(
    avatar: WildGHandAvatar, side: str, clip: np.ndarray, count: int, random: np.random.Generator
) -> np.ndarray:
    """(count, 16, 3) poses within the limits of the joints; the wrist is as in the clip."""
    limits = anatomical_limits(load_template(avatar.hand_model.source, side))
    share = random.uniform(0.2, 1.0, (count, 1, 1))
    angles = share * random.uniform(limits.lower, limits.upper, (count, 15, 3))
    fingers = pose_from_joint_angles(torch.as_tensor(angles), torch.as_tensor(limits.axes))
    wrists = clip[random.integers(0, len(clip), count), :1]
    return np.concatenate([wrists, fingers.numpy()], axis=1)


def _check(avatar: WildGHandAvatar, capture: Capture) -> None:
    if len(shown_sides(avatar, capture)) < len(avatar.sides):
        raise UsageError(
            f"shows the {capture.info.hands} hand alone, the avatar has two", where=capture.root
        )
    if not avatar.is_of(capture):
        origin = str(avatar.record.source.get("capture"))[:100]
        raise UsageError(
            f"is not the import of {origin!r} that the avatar was fitted to",
            where=capture.root,
            remedy="Give the capture of its fit. A fit of a video that was stopped has imported "
            "the video again: end it.",
        )


def _fitted(avatar: WildGHandAvatar, capture: Capture) -> list[int]:
    """The fitted frames that show every hand of the avatar."""
    valid = [capture.hands[side].valid for side in avatar.sides]
    found = [frame for frame in avatar.record.frames if all(one[frame] for one in valid)]
    if not found:
        raise UsageError("has no fitted frame that shows every hand", where=capture.root)
    return found


# Field of view of the still image, and how much of it the hand fills.
_FOCAL, _FILLED = 2.0, 0.8


def still_image(avatar: WildGHandAvatar, samples: PoseSamples, size: int) -> bytes:
    """PNG with transparency of the hands at the start, from the camera's side."""
    poses = {side: samples.start[side] for side in avatar.sides}
    means = avatar.pose(poses).means
    centre = (means.min(axis=0) + means.max(axis=0)) / 2.0
    radius = float(np.linalg.norm(means - centre, axis=1).max())
    viewmat = samples.viewmat.copy()
    viewmat[:3, 3] = [0.0, 0.0, radius * _FOCAL * 2.0 / _FILLED] - viewmat[:3, :3] @ centre
    K = np.array([[_FOCAL * size, 0, size / 2], [0, _FOCAL * size, size / 2], [0, 0, 1]])
    rgba = avatar.render(poses, Camera(K, viewmat, size, size))
    straight = rgba[..., :3] / np.maximum(rgba[..., 3:], 1e-6)
    whole = np.concatenate([straight[..., ::-1], rgba[..., 3:]], axis=-1).clip(0.0, 1.0)
    return bytes(cv2.imencode(".png", np.rint(whole * 255.0).astype(np.uint8))[1])


@torch.no_grad()
def mean_weights(
    avatar: WildGHandAvatar, capture: Capture, masks: Mapping[int, np.ndarray]
) -> dict[str, np.ndarray]:
    """Average weight masks (255 = full weight) over the frames that show each Gaussian's anchor.

    Returns:
        (N,) by side, in [0, 1]; NaN where no frame shows the anchor. Empty without masks.
    """
    rigs = avatar.model.rigs
    sums = {side: np.zeros((2, len(rig))) for side, rig in rigs.items()}
    for frame, mask in masks.items():
        hands, camera = capture.hand_poses(frame), capture.camera(frame)
        given = avatar.posed({side: hands[side] for side in rigs})
        anchors = {side: rigs[side].pose(*values) for side, values in given.items()}
        viewmat, K = (
            torch.as_tensor(m, dtype=torch.float32, device=avatar.device)
            for m in (camera.viewmat, camera.K)
        )
        size = torch.Size((camera.height, camera.width))
        shown = seen_anchors(anchors, viewmat[None], K[None], size)
        for side, (pixels, facing) in shown.items():
            # Masks have the size of the frame, unless a person has made them smaller.
            scale = np.array(mask.shape[::-1]) / (camera.width, camera.height)
            places = pixels[0].cpu().numpy() * scale
            weight = sample(mask, places) / 255.0
            counts = (facing[0] > 0.0).cpu().numpy()
            sums[side] += counts * np.stack([weight, np.ones_like(weight)])
    if not masks:
        return {}
    with np.errstate(invalid="ignore"):
        return {side: total / count for side, (total, count) in sums.items()}


# In the order in which they are run.
_SCRIPTS = ("hand.js", "gaussians.js", "splats.js", "controls.js")


@dataclass(frozen=True)
class PageFacts:
    """Facts about a page that was written."""

    #: Size of the file, bytes.
    bytes: int
    #: Gaussians of all hands.
    gaussians: int
    #: Training frames that are played.
    frames: int


def write_page(
    avatar: WildGHandAvatar | Path,
    out: Path,
    *,
    capture: Capture | None = None,
    hand: str | None = None,
    settings: PageSettings | None = None,
    overwrite: bool = False,
) -> PageFacts:
    """Write an avatar as one HTML file that needs no other file and no network.

    Args:
        avatar: the avatar, or the folder that `wildghand fit` has written.
        out: the file.
        capture: whose motion is played, where the avatar was fitted to it; it also gives the
            pose and the camera at the start. None: the hand is at rest.
        hand: source of the hand model (`anny`, `mano:PATH`).
        settings: None: the default.
        overwrite: replace what exists.

    Raises:
        BadInput: no avatar of `wildghand fit`, or one with numbers that are not finite.
        UsageError: `out` exists, or the capture is of other hands or another hand model.
        HwpError: the place cannot be written.
    """
    settings = settings or PageSettings()
    refuse_existing_file(out, overwrite=overwrite)
    if isinstance(avatar, Path):
        avatar = load_avatar(avatar, hand=hand)
    samples = sample_poses(avatar, capture, settings)
    avatar.pose(dict(samples.start), closed=True).require_finite()
    network = network_content(avatar)
    hands = {
        side: hand_content(
            avatar, side, samples.learnt[side], tabled=network is None, rank=settings.rank
        )
        for side in avatar.sides
    }
    weights = {} if capture is None else mean_weights(avatar, capture, avatar.weight_masks)
    content = {
        "network": network,
        "light": light_content(avatar),
        "hands": [
            {
                **hand,
                **hand_controls(avatar, side),
                "seen": avatar.model.visibility is not None,
                "biases": biases_content(avatar, side, samples.frames),
                "trusted": _trusted(weights.get(side), hand["count"]),
                "start": samples.start[side].pose.tolist(),
                "transl": samples.start[side].transl.tolist(),
                "motion": pack(samples.motion[side].astype("<f4")),
            }
            for side, hand in hands.items()
        ],
        "viewmat": samples.viewmat.tolist(),
        "shown": samples.shown.round(4).tolist(),
        "frames": samples.frames,
        "omega": _by_frame(avatar, samples.frames),
        "weights": _weights(avatar, samples.frames),
    }
    record, count = avatar.record, sum(hand["count"] for hand in hands.values())
    steps = f"{record.steps:,} steps"
    if record.chosen_steps is not None:
        steps = f"the state of step {record.chosen_steps:,} of {record.steps:,}"
    facts = [f"{count:,} Gaussians", f"{steps} on {len(record.frames)} frames"]
    still = base64.b64encode(still_image(avatar, samples, settings.still_size)).decode()
    html = render_template(
        "wildghand.page",
        "avatar.html.j2",
        title=f"{' and '.join(avatar.sides).capitalize()} hand",
        source=str(record.source.get("capture", ""))[:80],
        facts=", ".join(facts),
        still=f"data:image/png;base64,{still}",
        style=_text("style.css"),
        scripts=[_text(name) for name in _SCRIPTS],
        content=content,
    )
    atomic_write(out, html, overwrite=overwrite, flag="--overwrite")
    return PageFacts(
        bytes=len(html.encode()),
        gaussians=count,
        frames=len(samples.frames),
    )


def show_page(avatar: WildGHandAvatar, *, size: int = 320) -> InlinePicture:
    """Show in a notebook the page on which an avatar is turned and posed.

    It adds some megabytes to the notebook, and takes some seconds to write. Where a notebook shows
    no pages there is a picture of the hand at rest.

    Args:
        avatar: the avatar.
        size: edge of the picture, px.

    Raises:
        UsageError: the size is out of range.
    """
    picture = avatar.show(REST, size=size)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "avatar.html"
        write_page(avatar, path)
        return dataclasses.replace(picture, page=path.read_text("utf-8"))


def _text(name: str) -> Markup:
    from markupsafe import Markup

    return Markup(files("wildghand.page").joinpath("templates", name).read_text("utf-8"))


def _trusted(weights: np.ndarray | None, count: int) -> str | None:
    """(N,) uint8 mean weights, 254 = full; 255 where no frame shows the place."""
    if weights is None:
        return None
    shares = np.rint(np.nan_to_num(weights).clip(0.0, 1.0) * 254.0)
    found = np.full(count, 255, np.uint8)
    found[: len(weights)] = np.where(np.isnan(weights), 255, shares)
    return pack(found)


def _by_frame(avatar: WildGHandAvatar, frames: Sequence[int]) -> list[float]:
    """Temporal weight of largest magnitude of each frame; empty without DPD."""
    if not avatar.record.temporal:
        return []
    table = np.array([*avatar.record.temporal.values()])
    largest = table[np.abs(table).argmax(axis=0), np.arange(table.shape[1])]
    return _of_frames(avatar, largest.tolist(), frames)


def _weights(avatar: WildGHandAvatar, frames: Sequence[int]) -> list[float]:
    """Weight of each frame in the fit; empty where all counted the same."""
    weights = avatar.record.frame_weights
    if len(weights) != len(avatar.record.frames) or np.ptp(weights) < 1e-9:
        return []
    return _of_frames(avatar, weights, frames)


def _of_frames(
    avatar: WildGHandAvatar, values: Sequence[float], frames: Sequence[int]
) -> list[float]:
    """Select the values of some of the fitted frames."""
    found = dict(zip(avatar.record.frames, values, strict=True))
    return [round(found[frame], 4) for frame in frames]
