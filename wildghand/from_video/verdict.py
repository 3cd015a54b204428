"""The verdict that ends a fit of a video: how good the avatar is, and what to film next.

The surface is seen where at least two of the frames that are looked at show it: an anchor that
faces the camera, that nothing of the hand hides, in the mask.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from hwp_bench.base.arrays import evenly
from hwp_bench.base.errors import BadInput, EmptyMask
from hwp_bench.base.files import read_json
from hwp_bench.base.records import parse_record
from hwp_bench.capture import Capture
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.hands.skeleton import palm_directions
from hwp_bench.metrics.score import score_frame
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.fitting.session import every_frame
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import HandRig
from wildghand.gaussians.training import TrainingClip
from wildghand.visibility import shown_frames

# Frames that the surface is looked for in, and drawn ones that are scored.
_LOOKED_AT, _SCORED = 120, 12
# Kept-out frames with a hand that are needed; with fewer, fitted ones are scored.
_LEAST_SCORED = 3
# Frames that must show a place.
_SEEN = 2.0
# Cosine between the normal of a place at rest and a direction from which on it is of that part.
_PART = 0.5
# Share of a part from which on it need not be filmed again, and under which it was not seen at all.
_ENOUGH, _NEVER = 0.4, 0.1
# Share of the tracked frames that a fit should follow.
_FOLLOWED = 0.9
#: The parts of a hand, and how each is filmed.
PARTS = {
    "palm": "show the palm to the camera for three seconds",
    "back": "turn the hand over for three seconds",
    "thumb side": "turn the side of the thumb to the camera for three seconds",
    "little finger side": "turn the side of the little finger to the camera for three seconds",
}


@dataclass(frozen=True)
class Verdict:
    """The worth of a fit."""

    #: Share of the surface that frames have shown, by side.
    surface_seen: dict[str, float]
    #: The same of each of `PARTS`.
    parts_seen: dict[str, dict[str, float]]
    #: Mean distance of the fitted joints from the tracker's landmarks, px of the video, by side.
    pose_error_px: dict[str, float]
    #: PSNR of the drawn hand, dB; None where no frame could be scored.
    psnr: float | None
    #: Number of the frames that it was taken of.
    psnr_frames: int
    #: Whether the fit had seen these frames.
    psnr_of: Literal["kept out", "fitted"]
    #: What would make the avatar better, the most important first.
    film_next: list[str]

    def lines(self) -> list[str]:
        """Say it in two lines."""
        parts = [
            f"{name} of the surface seen"
            for name in _by_side(self.surface_seen, lambda v: f"{v:.0%}")
        ]
        errors = _by_side(self.pose_error_px, lambda v: f"{v:.1f} px")
        parts += [f"poses {name} from the tracked landmarks" for name in errors]
        if self.psnr is not None:
            parts.append(f"{self.psnr:.1f} dB on {self.psnr_frames} {self.psnr_of} frames")
        told = "; ".join(self.film_next) or "nothing is missing: all sides were seen"
        return [f"verdict: {', '.join(parts)}", f"film next: {told}"]


def _by_side(values: Mapping[str, float], shown: Any) -> list[str]:
    if len(values) == 1:
        return [shown(value) for value in values.values()]
    return [f"{side} {shown(value)}" for side, value in values.items()]


def read_verdict(path: str | os.PathLike[str]) -> Verdict:
    """Read what `judge_avatar` made and was written as JSON."""
    value = read_json(path)
    return parse_record(Verdict, value, where=str(Path(path)), error=BadInput)


@torch.no_grad()
def judge_avatar(avatar: WildGHandAvatar, capture: Capture) -> Verdict:
    """Judge an avatar by the capture that it was fitted to."""
    seen, parts, film = {}, {}, []
    fitted = avatar.record.frames
    looked = np.array(fitted)[evenly(len(fitted), _LOOKED_AT)]
    posed = avatar.believed_capture(capture)
    clip = TrainingClip(posed, looked, avatar.model.rigs, torch.device("cpu"))

    def visible(rows: torch.Tensor) -> torch.Tensor:
        masks = [capture.mask(int(looked[row])) for row in rows.tolist()]
        return torch.from_numpy(np.stack(masks)).float() / 255.0

    shown = shown_frames(avatar.model.rigs, clip, visible, len(looked))
    facts = capture.info.source.get("fit", {})
    hands = facts.get("hands") or dict.fromkeys(avatar.sides, facts)
    errors: dict[str, float] = {}
    for side, rig in avatar.model.rigs.items():
        here = (shown[side] >= min(_SEEN, len(looked))).numpy()
        places = parts_of(rig, side).items()
        seen[side] = round(float(here.mean()), 3)
        parts[side] = {name: round(float(here[part].mean()), 3) for name, part in places}
        named = "" if len(avatar.sides) == 1 else f" of the {side} hand"
        for name, share in sorted(parts[side].items(), key=lambda item: item[1]):
            if share < _ENOUGH:
                some = "" if share < _NEVER else f"only {share:.0%} of "
                seldom = "was seen" if some else "was never seen"
                film.append(f"{some}the {name}{named} {seldom}: {PARTS[name]}")
        fit = hands.get(side, {})
        if "reprojection_px" in fit:
            errors[side] = float(fit["reprojection_px"]["mean"])
            valid, tracked = fit["frames_valid"], fit["frames_detected"]
            if valid < _FOLLOWED * tracked:
                lost = f"{tracked - valid} of {tracked} frames could not be followed"
                film.append(f"{lost}{named}: move the hand more slowly")
    return Verdict(seen, parts, errors, *_score(avatar, capture), film)


def parts_of(rig: HandRig, side: str) -> dict[str, np.ndarray]:
    """The anchors (N,) bool of each of `PARTS`, by their normals on the hand at rest."""
    rest = rig.pose(torch.zeros(1, 16, 3), torch.zeros(10), torch.zeros(1, 3))
    normals = quat_third_axis(rest.orientations)[0].numpy()
    directions = palm_directions(rig.template.joints.double().numpy(), side)
    along = {
        "palm": normals @ directions.palmar,
        "back": -normals @ directions.palmar,
        "thumb side": normals @ directions.thumbward,
        "little finger side": -normals @ directions.thumbward,
    }
    return {name: cosine > _PART for name, cosine in along.items()}


def _score(avatar: WildGHandAvatar, capture: Capture) -> tuple[float | None, int, Any]:
    """PSNR over frames at the end that the fit has not seen, else over fitted ones."""
    frames, kept_out = np.array(avatar.record.frames), False
    whole, parted = (
        every_frame(capture, tested=True),
        contiguous_split(capture.info.id, len(capture)),
    )
    for split in (whole, parted):
        valid = [capture.hands[side].valid[split.test] for side in avatar.sides]
        test = split.test[np.all(valid, axis=0)]
        if len(test) >= _LEAST_SCORED and not np.isin(test, avatar.record.frames).any():
            frames, kept_out = test, True
    found = []
    for frame in frames[evenly(len(frames), _SCORED)].tolist():
        poses = {side: capture.hand_poses(frame)[side] for side in avatar.sides}
        drawn = avatar.render(poses, capture.camera(frame))[..., :3]
        with contextlib.suppress(EmptyMask):
            scores = score_frame(drawn, capture.frame(frame), capture.mask(frame))
            found.append(scores["psnr"])
    mean = round(float(np.mean(found)), 2) if found else None
    return mean, len(found), "kept out" if kept_out else "fitted"
