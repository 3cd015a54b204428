"""Which side a hand is of, by fitting the model to its landmarks as a right and as a left hand.

A hand and its mirror image look alike in outline. But fingers bend to one side only, and the
tracker's landmarks in space say to which: of the wrong side, the model with its joint limits
cannot follow them. The network's votes for a side do not enter, so that the two can be compared.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.base.arrays import evenly
from hwp_bench.base.console import notice
from hwp_bench.hands import load_template, pose_hand
from hwp_bench.importers.shared.hand_tracks import SIDES
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.video.clip_model import ClipModel
from hwp_bench.importers.video.fit_clip import CONSTANTS, Footage, descend
from hwp_bench.importers.video.fit_terms import LandmarkEnergy
from hwp_bench.importers.video.rigid_start import rigid_start
from hwp_bench.importers.video.video_settings import FitSettings

#: Frames that are fitted, evenly spread over those with a detection.
_FRAMES = 12
#: Steps of Adam; the remaining error of a right and of a left hand has parted long before.
_STEPS = 60
#: One side fits better for certain if the other's error is larger by this factor.
CLEAR = 1.15
#: The frames are far apart, so that motion between them is not smooth.
_SETTINGS = FitSettings(motion_weight=0.0)


@dataclass(frozen=True)
class SideScores:
    """Mean distances between the tracker's landmarks in space and the fitted hand's, m.

    Attributes:
        right: fitted as a right hand.
        left: fitted as a left hand.
        frames: number of fitted frames.
    """

    right: float
    left: float
    frames: int

    @property
    def better(self) -> str:
        """The side that fits better, `right` if both fit equally."""
        return "right" if self.right <= self.left else "left"

    @property
    def is_clear(self) -> bool:
        """Whether one side fits better for certain."""
        return max(self.right, self.left) > CLEAR * min(self.right, self.left)


def side_scores(landmarks: Landmarks, hand_model: str, footage: Footage) -> SideScores:
    """Fit a hand as a right and as a left one to some frames, and measure what remains.

    Args:
        landmarks: of one hand; at least one frame is detected.
        hand_model: as `load_template` takes it.
        footage: of these frames.
    """
    seen = np.flatnonzero(landmarks.detected)
    chosen = evenly(len(seen), _FRAMES)
    few = landmarks.select(seen[chosen])
    right, left = (_remaining(few, side, hand_model, footage) for side in SIDES)
    return SideScores(right, left, len(chosen))


def warn_of_contradiction(
    side: str, scores: SideScores, votes: Mapping[str, float] | None, *, stated: bool = True
) -> bool:
    """Warn where a hand is imported as one of a side, and the pictures show the other one.

    Args:
        side: `right` or `left`.
        scores: of the fits.
        votes: the network's mean probability of each side, None where the landmarks have none.
        stated: whether a person has stated the side; else it is what the votes say.

    Returns:
        Whether there was a warning. The fit decides where it is clear, else the votes.
    """
    voted = None if votes is None else max(SIDES, key=lambda side: votes[side])
    shown = scores.better if scores.is_clear else voted
    if shown is None or shown == side:
        return False
    voted_for = "" if votes is None else f"the tracker votes {_votes(votes)}"
    if stated:
        said = (
            f"the hand is said to be a {side} one, but {voted_for}{', and ' if voted_for else ''}"
        )
    else:
        said = f"{voted_for} for a hand that is taken for a {side} one, but "
    notice(
        f"warning: {said}the hand model misses the "
        f"landmarks by {_misses(scores)} ({scores.frames} frames). With the wrong side, palm and "
        "back are swapped. A mirrored video also looks like this."
    )
    return True


def _votes(votes: Mapping[str, float]) -> str:
    return f"right {votes['right']:.2f}, left {votes['left']:.2f}"


def _misses(scores: SideScores) -> str:
    return f"{1e3 * scores.right:.1f} mm as a right hand, {1e3 * scores.left:.1f} mm as a left one"


def _remaining(landmarks: Landmarks, side: str, hand_model: str, footage: Footage) -> float:
    """Mean distance of the fitted landmarks from the tracker's in space, m."""
    template = load_template(hand_model, side)
    rest = pose_hand(
        template.to_torch(torch.float64),
        torch.zeros(1, 16, 3, dtype=torch.float64),
        torch.zeros(10, dtype=torch.float64),
        torch.zeros(1, 3, dtype=torch.float64),
    ).landmarks[0]
    focal = footage.first_focal
    start = rigid_start(landmarks, rest.numpy(), focal, footage.centre)
    model = ClipModel(template, start, focal, footage.centre)
    energy = LandmarkEnergy(landmarks, model, _SETTINGS, footage.fps, focal)
    descend(model, energy.from_afar, _STEPS, hold=CONSTANTS)
    with torch.no_grad():
        fitted = model.posed().landmarks
        centred = fitted - fitted.mean(dim=1, keepdim=True)
        return float(torch.linalg.vector_norm(centred - energy.world, dim=-1).mean())
