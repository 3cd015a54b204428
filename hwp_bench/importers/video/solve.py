"""Fitting a hand to a whole clip: its landmarks, then its outline too, then whole pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields

import numpy as np
import torch

from hwp_bench.base.errors import DidNotConverge
from hwp_bench.base.evenly import evenly
from hwp_bench.base.progress import notice
from hwp_bench.hands import HandTemplate, load_template, pose_hand
from hwp_bench.importers.shared.landmarks import LANDMARK_NAMES, SIDES, Landmarks
from hwp_bench.importers.video.model import ClipModel, PosedClip, rigid_start
from hwp_bench.importers.video.pictures import PictureEnergy, TextureEnergy
from hwp_bench.importers.video.residuals import ContourEnergy, FitSettings, LandmarkEnergy

#: Likely focal length where none is given, as a share of the image's longer
#: side: a horizontal field of view of 64 degrees, between a webcam and a phone's main camera.
LIKELY_FOCAL = 0.8
#: Variables that are the same in all frames; they are held until every frame has found its pose.
CONSTANTS = ("betas", "offsets", "log_size", "log_focal")
# Variables that the outline does not determine reliably.
_HELD_BY_LANDMARKS = ("log_focal", "log_size")
# Those that whole pictures would move to hide what else is wrong with them: the outline knows
# how large a hand is and how far away.
_HELD_BY_OUTLINE = (*CONSTANTS, "log_depth")
#: First step of each variable, in its own unit; constants move slower than poses.
LEARNING_RATES = {
    "turn": 0.02,
    "fingers": 0.03,
    "anchor": 0.03,
    "log_depth": 0.01,
    "betas": 0.02,
    "offsets": 0.0003,
    "log_size": 0.003,
    "log_focal": 0.003,
}
# The rate rises over the first steps and ends at this share.
_WARM_UP = 20
_LAST_RATE = 0.02


@dataclass(frozen=True)
class Footage:
    """Size, rate and focal length of the frames.

    Attributes:
        width: whole frame, px.
        height: px.
        fps: frames per second between the selected frames.
        focal: focal length in px, or None to estimate it.
    """

    width: int
    height: int
    fps: float
    focal: float | None

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
    """A fit in progress: the model with its variables, and the energy without images.

    Attributes:
        model: the clip.
        energy: landmark energy.
        settings: as fitted.
    """

    model: ClipModel
    energy: LandmarkEnergy
    settings: FitSettings


@dataclass(frozen=True)
class ReprojectionError:
    """Distance between fitted and tracked landmarks in the detected frames, px.

    Attributes:
        mean: over frames and the 21 landmarks.
        median: over both.
        percentile_95: over both.
        worst_landmark: name of the landmark with the largest mean.
        worst_landmark_mean: its mean.
        without_offsets: mean where the model's bare joints and finger tips are compared.
        by_frame: (F,) mean of each frame; NaN where no hand was detected.
    """

    mean: float
    median: float
    percentile_95: float
    worst_landmark: str
    worst_landmark_mean: float
    without_offsets: float
    by_frame: np.ndarray


def fit_landmarks(
    landmarks: Landmarks,
    template: HandTemplate,
    footage: Footage,
    settings: FitSettings,
    update: Callable[[int], None] | None = None,
) -> FittedClip:
    """Fit pose, shape, place and (unless given) focal length to the landmarks of a clip.

    Raises:
        DidNotConverge: the energy left the finite numbers.
    """
    rest = pose_hand(
        template.to_torch(torch.float64),
        torch.zeros(1, 16, 3, dtype=torch.float64),
        torch.zeros(10, dtype=torch.float64),
        torch.zeros(1, 3, dtype=torch.float64),
    ).landmarks[0]
    focal = footage.first_focal
    start = rigid_start(landmarks, rest.numpy(), focal, footage.centre)
    model = ClipModel(template, start, focal, footage.centre)
    energy = LandmarkEnergy(
        landmarks, model, settings, footage.fps, focal if footage.focal is None else None
    )
    hold = () if footage.focal is None else ("log_focal",)
    descend(model, energy.from_afar, settings.start_steps, hold=CONSTANTS, update=update)

    def later(step: int) -> None:
        if update is not None:
            update(settings.start_steps + step)

    descend(model, energy, settings.landmark_steps, hold=hold, update=later)
    return FittedClip(model, energy, settings)


def share_camera(hands: Sequence[FittedClip], *, steps: int) -> None:
    """Give hands that one camera sees one focal length, in place, and fit their poses to it.

    It is the mean of the logarithms of those that were fitted, weighted by frames. Places move
    along their rays and stay in the image.

    Args:
        hands: fitted to the landmarks of one video.
        steps: of Adam after that.
    """
    weights = [float(hand.energy.weight.sum()) for hand in hands]
    logs = [float(hand.model.variables.log_focal.detach()) for hand in hands]
    shared = float(np.average(logs, weights=weights))
    for hand, own in zip(hands, logs, strict=True):
        with torch.no_grad():
            hand.model.variables.log_focal.fill_(shared)
            hand.model.variables.log_depth.add_(shared - own)
        descend(
            hand.model,
            hand.energy,
            steps,
            rate=hand.settings.contour_rate,
            hold=("log_focal",),
        )


def fit_outline(
    fitted: FittedClip,
    contour: ContourEnergy,
    update: Callable[[int], None] | None = None,
    texture: TextureEnergy | None = None,
) -> None:
    """Refine a fit, in place, so that the mesh's outline meets the masks' outline.

    With a texture, what lies inside the outline meets the mean of all frames, too.
    """
    _refine(
        fitted,
        [contour] if texture is None else [contour, texture],
        rounds=fitted.settings.contour_rounds,
        steps=fitted.settings.contour_steps,
        hold=_HELD_BY_LANDMARKS,
        update=update,
    )


def fit_picture(
    fitted: FittedClip,
    picture: PictureEnergy,
    update: Callable[[int], None] | None = None,
) -> None:
    """Refine the poses of a fit, in place, so that the lit hand, as it is drawn, meets the frames.

    Shape, size and distance of the hand stay.
    """
    _refine(
        fitted,
        [picture],
        rounds=fitted.settings.picture_rounds,
        steps=fitted.settings.picture_steps,
        hold=_HELD_BY_OUTLINE,
        update=update,
    )


def _refine(
    fitted: FittedClip,
    terms: Sequence[ContourEnergy | TextureEnergy | PictureEnergy],
    *,
    rounds: int,
    steps: int,
    hold: tuple[str, ...],
    update: Callable[[int], None] | None,
) -> None:
    """Refine a fit, in place, by terms that are matched to the images again in each round."""

    def energy(model: ClipModel, posed: PosedClip) -> torch.Tensor:
        value = fitted.energy(model, posed)
        for term in terms:
            value = value + term(model, posed)
        return value

    for done in range(rounds):
        for term in terms:
            term.rematch(fitted.model)
        descend(fitted.model, energy, steps, rate=fitted.settings.contour_rate, hold=hold)
        if update is not None:
            update((done + 1) * steps)


def reprojection_error(fitted: FittedClip, landmarks: Landmarks) -> ReprojectionError:
    """Measure how well the fit explains the tracked landmarks."""
    model = fitted.model
    with torch.no_grad():
        pixels = model.pixels(model.posed().landmarks).numpy()
        offsets = model.variables.offsets.clone()
        model.variables.offsets.zero_()
        bare = model.pixels(model.posed().landmarks).numpy()
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
    energy: Callable[[ClipModel, PosedClip], torch.Tensor],
    steps: int,
    *,
    rate: float = 1.0,
    hold: tuple[str, ...] = (),
    update: Callable[[int], None] | None = None,
) -> float:
    """Lower an energy over the model's variables, in place.

    Args:
        model: the clip.
        energy: maps the model and its posed clip to a scalar.
        steps: number of steps.
        rate: factor on all learning rates.
        hold: variables that stay.
        update: called with the number of steps done.

    Returns:
        The last energy.

    Raises:
        DidNotConverge: the energy is not finite.
    """
    groups = [
        {"params": [getattr(model.variables, field.name)], "lr": rate * LEARNING_RATES[field.name]}
        for field in fields(model.variables)
        if field.name not in hold
    ]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))

    def schedule(step: int) -> float:
        fall = 0.5 * (1.0 + math.cos(math.pi * step / max(steps, 1)))
        return min(1.0, (step + 1) / _WARM_UP) * (_LAST_RATE + (1.0 - _LAST_RATE) * fall)

    scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, schedule)
    with _one_thread():
        return _run(model, energy, steps, optimizer, scheduler, update)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Hold torch to one thread: the operations here are too small to be parallel.

    On a busy machine the threads of a small operation wait for each other, and a fit takes
    several times as long.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _run(
    model: ClipModel,
    energy: Callable[[ClipModel, PosedClip], torch.Tensor],
    steps: int,
    optimizer: torch.optim.Optimizer,
    scheduler: torch.optim.lr_scheduler.LRScheduler,
    update: Callable[[int], None] | None,
) -> float:
    value = math.nan
    for step in range(steps):
        optimizer.zero_grad(set_to_none=True)
        loss = energy(model, model.posed())
        value = float(loss.detach())
        if not math.isfinite(value):
            raise DidNotConverge(
                f"the fit of the hand left the finite numbers in step {step}",
                remedy="Check the landmarks; a focal length far off can do this too (--focal).",
            )
        loss.backward()
        optimizer.step()
        scheduler.step()
        if update is not None:
            update(step + 1)
    return value


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
