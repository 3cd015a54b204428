"""The terms of the fit's energy: each a sum over frames of robust functions, in no unit."""

from __future__ import annotations

import numpy as np
import torch

from hwp_bench.hands.joint_limits import anatomical_limits, joint_limit_penalty
from hwp_bench.importers.clip_model import ClipModel, PosedClip
from hwp_bench.importers.fit_settings import FitSettings
from hwp_bench.importers.landmarks import Landmarks
from hwp_bench.importers.self_contact import ContactEnergy


class LandmarkEnergy:
    """Everything that does not need the pictures: landmarks, smoothness, anatomy, priors.

    Args:
        landmarks: of the clip; frames without a detection count only in the other terms.
        model: the clip.
        settings: weights and scales.
        fps: frames per second; the smoothness scales are per (1/30 s)^2.
        default_focal: px, what the focal length is drawn to; None = it is known and held.
    """

    def __init__(
        self,
        landmarks: Landmarks,
        model: ClipModel,
        settings: FitSettings,
        fps: float,
        default_focal: float | None,
    ) -> None:
        self.settings = settings
        self.default_focal = default_focal
        self.image = torch.as_tensor(landmarks.image, dtype=torch.float32)
        self.weight = torch.as_tensor(
            np.where(landmarks.detected, landmarks.score, 0.0), dtype=torch.float32
        )[:, None]
        self.world = model.world - model.world.mean(dim=1, keepdim=True)
        self.hand_size = hand_size(landmarks)
        self.limits = anatomical_limits(model.template)
        self.contact = ContactEnergy(model.template, settings.contact_scale)
        self.pace = (30.0 / fps) ** 2
        self.prior = settings.prior_share * float(landmarks.detected.sum())

    def __call__(self, model: ClipModel, posed: PosedClip) -> torch.Tensor:
        """Return the energy, a scalar."""
        picture = geman_mcclure(self._image_error(model, posed))
        data = (self.weight * picture).sum() + self.settings.world_weight * self._world(
            model, posed
        )
        return data + self._rest(model, posed)

    def from_afar(self, model: ClipModel, posed: PosedClip) -> torch.Tensor:
        """Return the energy for the first steps, when most fingers are bent wrongly.

        The world landmarks lead, because only they say whether a finger bends to or fro; the
        image landmarks, however far off, do no more than to place the hand.
        """
        settings = self.settings
        picture = (self.weight * charbonnier(self._image_error(model, posed))).sum()
        data = settings.start_image_weight * picture + self._world(model, posed)
        return data + self._rest(model, posed)

    def _image_error(self, model: ClipModel, posed: PosedClip) -> torch.Tensor:
        scale = self.settings.image_scale * self.hand_size
        return (((model.pixels(posed.landmarks) - self.image) / scale) ** 2).sum(dim=-1)

    def _world(self, model: ClipModel, posed: PosedClip) -> torch.Tensor:
        # Compared at the tracker's own scale: measured at the hand's, a hand that shrinks to
        # nothing would fit best.
        centred = posed.landmarks - posed.landmarks.mean(dim=1, keepdim=True)
        error = centred * torch.exp(-model.variables.log_size) - self.world
        squared = ((error / self.settings.world_scale) ** 2).sum(dim=-1)
        return (self.weight * charbonnier(squared)).sum()

    def _rest(self, model: ClipModel, posed: PosedClip) -> torch.Tensor:
        return self._motion(model, posed) + self._priors(model, posed)

    def _motion(self, model: ClipModel, posed: PosedClip) -> torch.Tensor:
        settings = self.settings
        energy = posed.landmarks.new_zeros(())
        for track, scale in (
            (posed.landmarks, settings.motion_scale),
            (model.variables.fingers, settings.turning_scale),
        ):
            if len(track) > 2:
                bend = (track[2:] - 2.0 * track[1:-1] + track[:-2]) / (scale * self.pace)
                energy = energy + charbonnier((bend**2).sum(dim=-1)).sum()
        return settings.motion_weight * energy

    def _priors(self, model: ClipModel, posed: PosedClip) -> torch.Tensor:
        settings, free = self.settings, model.variables
        anatomy = settings.limit_weight * joint_limit_penalty(posed.pose, self.limits).sum()
        anatomy = anatomy + settings.contact_weight * self.contact(model, posed)
        anatomy = anatomy + settings.pose_weight * (free.fingers**2).sum()
        constant = (free.betas**2).sum()
        constant = constant + ((free.offsets / settings.offset_scale) ** 2).sum()
        constant = constant + (free.log_size / settings.size_scale) ** 2
        if self.default_focal is not None:
            focal = (free.log_focal - float(np.log(self.default_focal))) / settings.focal_scale
            constant = constant + focal**2
        return anatomy + 0.5 * self.prior * constant


def hand_size(landmarks: Landmarks) -> float:
    """Median over the frames of the larger side of the landmarks' box, px."""
    pixels = landmarks.image[landmarks.detected]
    return float(np.median((pixels.max(axis=1) - pixels.min(axis=1)).max(axis=1)))


def geman_mcclure(squared: torch.Tensor, turn: float = 2.0) -> torch.Tensor:
    """r^2 / (1 + r^2 / (4 turn^2)): quadratic for small r, constant for outliers.

    Args:
        squared: residual over scale, squared.
        turn: residual, in scales, beyond which the pull fades.

    Source: Geman and McClure, 1987, scaled to the second derivative of r^2.
    """
    return squared / (1.0 + squared / (4.0 * turn * turn))


def charbonnier(squared: torch.Tensor) -> torch.Tensor:
    """2 (sqrt(1 + r^2) - 1): quadratic for small r, linear beyond."""
    return 2.0 * (torch.sqrt(1.0 + squared) - 1.0)
