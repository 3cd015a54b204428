"""Fitting a hand to a whole clip: first its landmarks, then its outline too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.hands import HandTemplate, pose_hand
from hwp_bench.importers.clip_model import ClipModel, PosedClip
from hwp_bench.importers.contour import ContourEnergy
from hwp_bench.importers.descent import descend
from hwp_bench.importers.fit_settings import FitSettings
from hwp_bench.importers.fit_start import rigid_start
from hwp_bench.importers.fit_terms import LandmarkEnergy
from hwp_bench.importers.landmarks import LANDMARK_NAMES, Landmarks

#: Focal length that is taken for likely where none is given, as a share of the picture's longer
#: side: a horizontal field of view of 64 degrees, between a webcam and a phone's main camera.
LIKELY_FOCAL = 0.8
# Variables that are the same in all frames; they wait until every frame has found its pose.
_CONSTANTS = ("betas", "offsets", "log_size", "log_focal")
# Variables that the outline says nothing reliable about.
_HELD_BY_LANDMARKS = ("log_focal", "log_size")


@dataclass(frozen=True)
class Footage:
    """What the fit knows of the pictures.

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
    """A fit in progress: the model with its variables, and the energy without pictures.

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
        by_frame: (F,) mean of each frame; NaN where nothing was detected.
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
    descend(model, energy.from_afar, settings.start_steps, hold=_CONSTANTS, update=update)

    def later(step: int) -> None:
        if update is not None:
            update(settings.start_steps + step)

    descend(model, energy, settings.landmark_steps, hold=hold, update=later)
    return FittedClip(model, energy, settings)


def fit_outline(
    fitted: FittedClip, contour: ContourEnergy, update: Callable[[int], None] | None = None
) -> None:
    """Refine a fit, in place, so that the mesh's outline meets the masks' outline."""
    settings = fitted.settings

    def energy(model: ClipModel, posed: PosedClip) -> torch.Tensor:
        return fitted.energy(model, posed) + contour(model, posed)

    for done in range(settings.contour_rounds):
        contour.rematch(fitted.model)
        descend(
            fitted.model,
            energy,
            settings.contour_steps,
            rate=settings.contour_rate,
            hold=_HELD_BY_LANDMARKS,
        )
        if update is not None:
            update((done + 1) * settings.contour_steps)


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
