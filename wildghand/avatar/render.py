"""Drawing an avatar along a capture: a clip, and what DPD took out of its frames."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hwp_bench.base.console import track
from hwp_bench.base.drawing import labelled, sheet
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_folder, check_places, refuse_existing_file, refuse_other
from hwp_bench.base.images import as_uint8, check_encoder, read_rgb, write_image, write_movie
from hwp_bench.capture import Capture
from hwp_bench.methods.contract import HandPose
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.gaussians.training import TrainingClip
from wildghand.model.frames import largest
from wildghand.splat.threads import denormals_flushed


def render_clip(
    avatar: WildGHandAvatar,
    capture: Capture,
    frames: range,
    out: Path,
    *,
    background: int = 0,
    video: Path | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Draw frames into a folder, whole or not at all; `overwrite` replaces it and the video."""
    refuse_other(out, "frames", _holds_frames)
    check_places({"out": out, "video": video}, {"poses": capture.root}, replaces=overwrite)
    shown_sides(avatar, capture)  # refuses a capture of other hands
    if video is not None:
        refuse_existing_file(video, overwrite=overwrite, field="--video")
        check_encoder()
    seconds = 0.0
    with atomic_folder(out, overwrite=overwrite, flag="--overwrite") as folder:
        for frame in track(frames, "Drawing"):
            hands, camera = hands_of(avatar, capture, frame), capture.camera(frame)
            started = time.perf_counter()
            rgba = avatar.render(hands, camera)
            seconds += time.perf_counter() - started
            behind = (1.0 - rgba[..., 3:]) * (background / 255.0)
            image = np.rint(255.0 * (rgba[..., :3] + behind)).clip(0, 255).astype(np.uint8)
            write_image(folder / f"{frame:06d}.png", image)
        if video is not None:
            # Within the block: where the video cannot be written, no folder refuses the next start.
            times = None
            if capture.info.times is not None:
                times = [
                    capture.info.times[frame] - capture.info.times[frames[0]] for frame in frames
                ]
            images = (read_rgb(folder / f"{frame:06d}.png") for frame in frames)
            write_movie(video, images, capture.info.fps, times)
    return {"frames": len(frames), "frames_per_second": len(frames) / max(seconds, 1e-9)}


def _holds_frames(folder: Path) -> bool:
    return all(re.fullmatch(r"\d{6}\.png", path.name) for path in folder.iterdir())


def shown_sides(avatar: WildGHandAvatar, capture: Capture) -> list[str]:
    """Return the hands of a capture that an avatar has."""
    sides = [side for side in capture.info.sides if side in avatar.sides]
    if not sides:
        raise UsageError(
            f"shows the {' and '.join(capture.info.sides)} hand, the avatar is of the "
            f"{' and '.join(avatar.sides)} hand",
            where=capture.root,
        )
    if capture.info.hand_model.name != avatar.hand_model.name:
        raise UsageError(
            f"has parameters of the hand model {capture.info.hand_model.name}, "
            f"the avatar takes those of {avatar.hand_model.name}",
            where=capture.root,
            remedy="Convert them with `hwp-bench data convert`.",
        )
    return sides


def hands_of(avatar: WildGHandAvatar, capture: Capture, frame: int) -> dict[str, HandPose]:
    """Return the hands of a frame that an avatar has, in its corrected poses and with its shape.

    The shape of a capture may be another person's.
    """
    shown = capture.hand_poses(frame)
    hands = avatar.believed({side: shown[side] for side in shown_sides(avatar, capture)})
    return {side: replace(hand, betas=avatar.betas[side]) for side, hand in hands.items()}


#: How much a difference of colours is stretched around grey in a picture.
_STRETCH = 2.0


@dataclass(frozen=True, eq=False)
class Explanation:
    """One training frame, and the avatar's part in it."""

    #: Frame of the capture.
    frame: int
    #: Temporal weight of largest magnitude among the hands.
    omega: float
    #: (H, W, 3) sRGB in [0, 1]: the frame over black outside the estimated mask.
    image: np.ndarray
    #: (H, W, 3) the hand as the avatar draws it: no bias, no gain.
    canonical: np.ndarray
    #: (H, W, 3) the hand with the frame's biases and gain.
    biased: np.ndarray


@denormals_flushed()
@torch.no_grad()
def explain_frames(
    avatar: WildGHandAvatar, capture: Capture, frames: Sequence[int] | None = None
) -> list[Explanation]:
    """Draw training frames without and with what is particular to them.

    Args:
        frames: of the capture; None: the eight of largest temporal weight, in order of time.
    """
    model, fitted = avatar.model, avatar.record.frames
    if not model.perturbation:
        raise UsageError(
            "was fitted without DPD", field="avatar", remedy="Fit it with dpd.enabled=true."
        )
    if not avatar.is_of(capture):
        origin = str(avatar.record.source.get("capture"))[:100]
        problem = f"was fitted to {origin!r}, not to this import of {capture.info.id!r}"
        raise UsageError(problem, field="avatar")
    rows = torch.arange(len(fitted), device=avatar.device)
    omegas = largest([hand.temporal(rows).omega for hand in model.biases]).abs()
    if frames is None:
        frames = sorted(fitted[row] for row in omegas.argsort(descending=True)[:8].tolist())
    for frame in frames:
        if frame not in fitted:
            raise UsageError(f"{frame} was not fitted", field="frames")
    posed = avatar.believed_capture(capture)
    clip = TrainingClip(posed, np.array(fitted), model.rigs, torch.device(avatar.device))
    info, found = capture.info, []
    for frame in frames:
        row = fitted.index(frame)
        pictures = []
        for biases in (False, True):
            given = torch.tensor([biases], device=avatar.device)
            drawing = model.draw_frames(
                clip,
                rows[row : row + 1],
                info.width,
                info.height,
                kept=dict.fromkeys(model.perturbation, given),
                move=given,
                refine=avatar.settings.heads,
                pose_head=biases,
            )
            image = drawing.image[0] if biases else drawing.image[0] / model.log_gains[row].exp()
            pictures.append(image.clamp(0.0, 1.0).cpu().numpy())
        seen = capture.frame(frame) / 255.0 * (capture.mask(frame)[..., None] / 255.0)
        found.append(Explanation(frame, float(omegas[row]), seen, *pictures))
    return found


@torch.no_grad()
def temporal_weights(
    avatar: WildGHandAvatar, capture: Capture
) -> dict[str, tuple[float, float | None]]:
    """The mean size of omega by hand, and its rank correlation with the frames' severity.

    See `CaptureInfo.rank_with_severity`.
    """
    frames, found = avatar.record.frames, {}
    rows = torch.arange(len(frames), device=avatar.device)
    for side in avatar.model.perturbation:
        temporal = avatar.model.biases_of(side).temporal(rows)
        sizes = temporal.omega.abs().cpu()
        rank = capture.info.rank_with_severity(frames, sizes.tolist())
        found[side] = float(sizes.numpy().mean()), rank
    return found


def explanation_sheet(
    found: Sequence[Explanation], names: Mapping[int, str] | None = None
) -> np.ndarray:
    """A sheet (H, W, 3) uint8 with a row for each frame.

    It shows the frame, the hand without biases and with them, and the difference of the two, grey
    where there is none.
    """
    tiles = []
    for item in found:
        acting = (names or {}).get(item.frame, "")
        difference = 0.5 + _STRETCH * (item.biased - item.canonical)
        for picture, caption in (
            (item.image, f"frame {item.frame} {acting}"),
            (item.canonical, "canonical"),
            (item.biased, f"with biases, omega {item.omega:.2f}"),
            (difference, f"difference x {_STRETCH:g}"),
        ):
            tiles.append(labelled(as_uint8(np.clip(picture, 0.0, 1.0).astype(np.float32)), caption))
    return sheet(tiles, 4)
