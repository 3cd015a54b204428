"""Fitting a hand to a clip: landmarks, then the outline too, then whole pictures; and its side."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch

from hwp_bench.base.arrays import evenly
from hwp_bench.hands import HandTemplate, load_template, pose_hand
from hwp_bench.hands.fitting import minimize
from hwp_bench.hands.skeleton import SIDES
from hwp_bench.importers.shared.landmarks import LANDMARK_NAMES, Landmarks
from hwp_bench.importers.video.gradients import ClipEnergy
from hwp_bench.importers.video.model import ClipModel, rigid_start
from hwp_bench.importers.video.pictures import PictureResidual, SurfaceResidual
from hwp_bench.importers.video.residuals import LandmarkResidual, OutlineResidual

#: Likely focal length where none is given, as a share of the image's longer
#: side: a horizontal field of view of 64 degrees, between a webcam and a phone's main camera.
LIKELY_FOCAL = 0.8
#: Steps of Adam in a round of whole pictures.
PICTURE_STEPS = 60
# Variables that are the same in all frames; they are held until every frame has found its pose.
_CONSTANTS = ("betas", "offsets", "log_size", "log_focal")
# Variables that the outline does not determine reliably.
_HELD_BY_LANDMARKS: tuple[str, ...] = ("log_focal", "log_size")
# Those that whole pictures would move to hide what else is wrong with them: the outline knows
# how large a hand is and how far away.
_HELD_BY_OUTLINE = (*_CONSTANTS, "log_depth")
# First step of each variable, in its own unit; constants move slower than poses.
_LEARNING_RATES = {
    "turn": 0.02,
    "fingers": 0.03,
    "anchor": 0.03,
    "log_depth": 0.01,
    "betas": 0.02,
    "offsets": 0.0003,
    "log_size": 0.003,
    "log_focal": 0.003,
}
# Factor on them once a clip follows its landmarks: only corrections are left.
_REFINING = 0.3
# Steps over which the rate rises.
_WARM_UP = 20

#: Called after each step.
Tick = Callable[[], None]


def _no_tick() -> None: ...


@dataclass(frozen=True)
class SolveSettings:
    """How long the fit of a clip takes; its weights and scales stand with the residuals."""

    #: Steps of Adam from the rigid start, with the world landmarks dominant.
    start_steps: int = 150
    #: Steps of Adam after that, on all landmarks, robust against outliers.
    landmark_steps: int = 450
    #: Steps of Adam in each round against the masks.
    contour_steps: int = 120
    #: Rounds after each cutting of masks: find the mesh's outline, pull it to the mask's outline.
    contour_rounds: int = 3
    #: Whether the clip's mean texture joins when the outline fits.
    texture: bool = True
    #: Rounds after the outline's: draw the lit hand, lay it onto the frames; 0 leaves them out.
    picture_rounds: int = 4


@dataclass(frozen=True)
class Footage:
    """Size, rate and focal length of the frames."""

    #: Whole frame, px.
    width: int
    height: int
    #: Selected frames per second.
    fps: float
    #: Focal length in px, or None to estimate it.
    focal: float | None
    #: (F,) s, when the selected frames were recorded; None where all steps are equal.
    times: np.ndarray | None = None

    def steps(self, count: int) -> np.ndarray:
        """Return the time between `count` frames, (F - 1,) in units of 1/30 s."""
        if self.times is None:
            return np.full(count - 1, 30.0 / self.fps)
        return np.asarray(30.0 * np.diff(self.times))

    @property
    def centre(self) -> np.ndarray:
        """(2,) principal point, px: the middle of the frame."""
        return np.array([self.width / 2.0, self.height / 2.0])

    @property
    def first_focal(self) -> float:
        """The given or the likely focal length, px."""
        return self.focal if self.focal is not None else LIKELY_FOCAL * max(self.width, self.height)


@dataclass(frozen=True, eq=False)
class FittedClip:
    """A fit in progress: the model with its variables, and the residual that needs no images."""

    model: ClipModel
    landmarks: LandmarkResidual
    settings: SolveSettings


@dataclass(frozen=True)
class ReprojectionError:
    """Distance between fitted and tracked landmarks in the detected frames, px."""

    #: Over frames and the 21 landmarks.
    mean: float
    median: float
    percentile_95: float
    #: Name of the landmark with the largest mean, and its mean.
    worst_landmark: str
    worst_landmark_mean: float
    #: Mean where the model's bare joints and finger tips are compared.
    without_offsets: float
    #: (F,) mean of each frame; NaN where no hand was detected.
    by_frame: np.ndarray


def start_model(landmarks: Landmarks, template: HandTemplate, footage: Footage) -> ClipModel:
    """The clip with a rigid hand in every frame."""
    rest = pose_hand(
        template.to_torch(torch.float64),
        torch.zeros(1, 16, 3, dtype=torch.float64),
        torch.zeros(10, dtype=torch.float64),
        torch.zeros(1, 3, dtype=torch.float64),
    ).landmarks[0]
    focal = footage.first_focal
    start = rigid_start(landmarks, rest.numpy(), focal, footage.centre)
    return ClipModel(template, start, focal, footage.centre)


def fit_landmarks(
    landmarks: Landmarks,
    template: HandTemplate,
    footage: Footage,
    settings: SolveSettings,
    tick: Tick = _no_tick,
) -> FittedClip:
    """Fit pose, shape, place and (unless given) focal length to the landmarks of a clip."""
    model = start_model(landmarks, template, footage)
    prior = footage.first_focal if footage.focal is None else None
    residual = LandmarkResidual(landmarks, model, footage.steps(len(landmarks.score)), prior)
    hold = () if footage.focal is None else ("log_focal",)
    afar = ClipEnergy(residual, afar=True)
    descend(model, afar, settings.start_steps, hold=_CONSTANTS, tick=tick)
    descend(model, ClipEnergy(residual), settings.landmark_steps, hold=hold, tick=tick)
    return FittedClip(model, residual, settings)


def share_camera(hands: Sequence[FittedClip], *, steps: int) -> None:
    """Give hands that one camera sees one focal length, in place, and fit their poses to it.

    It is the mean of the logarithms of those that were fitted, weighted by frames. Places move
    along their rays and stay in the image.
    """
    weights = [float(hand.landmarks.weight.sum()) for hand in hands]
    logs = [float(hand.model.variables.log_focal.detach()) for hand in hands]
    shared = float(np.average(logs, weights=weights))
    for hand, own in zip(hands, logs, strict=True):
        with torch.no_grad():
            hand.model.variables.log_focal.fill_(shared)
            hand.model.variables.log_depth.add_(shared - own)
        descend(hand.model, ClipEnergy(hand.landmarks), steps, rate=_REFINING, hold=("log_focal",))


def refine(
    fitted: FittedClip,
    outline: OutlineResidual | None,
    surface: SurfaceResidual | None = None,
    *,
    tick: Tick = _no_tick,
) -> None:
    """Refine a fit, in place, by residuals that are matched to the images in each round.

    With an outline, the mesh's outline meets the masks'; with a texture, what lies inside meets the
    mean of all frames. With whole pictures the lit hand, as it is drawn, meets the frames, and its
    shape, size and distance stay.
    """
    chosen, hold = fitted.settings, _HELD_BY_LANDMARKS
    rounds, steps = chosen.contour_rounds, chosen.contour_steps
    if isinstance(surface, PictureResidual):
        rounds, steps, hold = chosen.picture_rounds, PICTURE_STEPS, _HELD_BY_OUTLINE
    energy = ClipEnergy(fitted.landmarks, outline, surface)
    for _ in range(rounds):
        for residual in (outline, surface):
            if residual is not None:
                residual.rematch(fitted.model)
        descend(fitted.model, energy, steps, rate=_REFINING, hold=hold, tick=tick)


def reprojection_error(fitted: FittedClip, landmarks: Landmarks) -> ReprojectionError:
    """Measure how well the fit explains the tracked landmarks."""
    model = fitted.model
    with torch.no_grad():
        pixels = model.pixels(model.pose().landmarks).numpy()
        offsets = model.variables.offsets.clone()
        model.variables.offsets.zero_()
        bare = model.pixels(model.pose().landmarks).numpy()
        model.variables.offsets.copy_(offsets)
    seen = landmarks.detected
    error = np.linalg.norm(pixels - landmarks.image, axis=-1)
    by_landmark = error[seen].mean(axis=0)
    worst = int(by_landmark.argmax())
    return ReprojectionError(
        mean=float(error[seen].mean()),
        median=float(np.median(error[seen])),
        percentile_95=float(np.percentile(error[seen], 95)),
        worst_landmark=LANDMARK_NAMES[worst],
        worst_landmark_mean=float(by_landmark[worst]),
        without_offsets=float(np.linalg.norm(bare - landmarks.image, axis=-1)[seen].mean()),
        by_frame=np.where(seen, error.mean(axis=1), np.nan),
    )


def descend(
    model: ClipModel,
    energy: ClipEnergy,
    steps: int,
    *,
    rate: float = 1.0,
    hold: tuple[str, ...] = (),
    tick: Tick = _no_tick,
) -> None:
    """Lower an energy over the model's variables but those of `hold`, in place, by Adam.

    `rate` is a factor on all learning rates.
    """
    groups = [
        {"params": [getattr(model.variables, field.name)], "lr": rate * _LEARNING_RATES[field.name]}
        for field in fields(model.variables)
        if field.name not in hold
    ]
    remedy = (
        "Check the landmarks; a focal length far off can do this too "
        "(`hwp-bench data import video --focal`)."
    )
    minimize(groups, lambda _: energy(model), steps, warm_up=_WARM_UP, remedy=remedy, tick=tick)


# --- Which side a hand is of
#
# A hand and its mirror image look alike in outline. But fingers bend to one side only, and the
# tracker's landmarks in space say to which: of the wrong side, the model with its joint limits
# cannot follow them. The network's votes for a side do not enter, so that the two can be compared.

#: One side fits better for certain if the other's error is larger by this factor.
CLEAR = 1.15
# Frames that are fitted, evenly spread over those with a detection.
_SIDE_FRAMES = 12
# Steps of Adam; the remaining error of a right and of a left hand has parted long before.
_SIDE_STEPS = 60


@dataclass(frozen=True)
class SideScores:
    """Mean distances between the tracker's landmarks in space and the fitted hand's, m."""

    #: Fitted as a right hand, and as a left one.
    right: float
    left: float
    #: Number of fitted frames.
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
    """Fit a hand as a right and as a left one to some frames, and measure what remains."""
    seen = np.flatnonzero(landmarks.detected)
    chosen = evenly(len(seen), _SIDE_FRAMES)
    few = landmarks.select(seen[chosen])

    def remaining(side: str) -> float:
        model = start_model(few, load_template(hand_model, side), footage)
        # The frames are far apart, so that motion between them is not smooth.
        residual = LandmarkResidual(few, model, None, footage.first_focal)
        descend(model, ClipEnergy(residual, afar=True), _SIDE_STEPS, hold=_CONSTANTS)
        with torch.no_grad():
            fitted = model.pose().landmarks.double().numpy()
        centred = fitted - fitted.mean(axis=1, keepdims=True)
        return float(np.linalg.norm(centred - residual.world, axis=-1).mean())

    right, left = (remaining(side) for side in SIDES)
    return SideScores(right, left, len(chosen))


def contradiction(
    side: str, scores: SideScores, votes: Mapping[str, float] | None, *, stated: bool = True
) -> str | None:
    """Say so where a hand is imported as one of a side and the pictures show the other.

    The fit decides where it is clear, else the network's votes, where the landmarks have them.
    `stated`: a person has stated the side; else it is what the votes say.
    """
    voted = None if votes is None else max(SIDES, key=lambda side: votes[side])
    shown = scores.better if scores.is_clear else voted
    if shown is None or shown == side:
        return None
    voted_for = ""
    if votes is not None:
        voted_for = f"the tracker votes right {votes['right']:.2f}, left {votes['left']:.2f}"
    if stated:
        also = f"{voted_for}, and " if voted_for else ""
        said = f"the hand is said to be a {side} one, but {also}"
    else:
        said = f"{voted_for} for a hand that is taken for a {side} one, but "
    return (
        f"{said}the hand model misses the landmarks by {1e3 * scores.right:.1f} mm as a right "
        f"hand, {1e3 * scores.left:.1f} mm as a left one ({scores.frames} frames), as in a "
        "mirrored video; with the wrong side, palm and back are swapped"
    )
