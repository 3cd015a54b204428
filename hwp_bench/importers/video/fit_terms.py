"""The terms of the fit's energy that need no images: landmarks, motion, anatomy, self-contact."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.hands import HandTemplate
from hwp_bench.hands.articulation import anatomical_limits, joint_limit_penalty
from hwp_bench.hands.skeleton import FINGERS, finger_joints, palm_directions, unit
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.video.clip_model import ClipModel, PosedClip
from hwp_bench.importers.video.video_settings import FitSettings

#: Share of the radii that counts: skin and flesh give way.
FIRMNESS = 0.85
# Slices along each finger segment and along each metacarpal.
_FINGER_SLICES = 2
_PALM_SLICES = 3
# A sphere of fewer vertices does not measure thickness.
_LEAST_VERTICES = 4


class LandmarkEnergy:
    """Everything that does not need the images: landmarks, smoothness, anatomy, priors.

    Args:
        landmarks: of the clip; frames without a detection count only in the other terms.
        model: the clip.
        settings: weights and scales.
        fps: frames per second; the smoothness scales are per (1/30 s)^2.
        default_focal: px, the focal length that the prior favours; None = it is known.
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
        image = geman_mcclure(self._image_error(model, posed))
        data = (self.weight * image).sum() + self.settings.world_weight * self._world(model, posed)
        return data + self._rest(model, posed)

    def from_afar(self, model: ClipModel, posed: PosedClip) -> torch.Tensor:
        """Return the energy for the first steps, when most fingers are bent wrongly.

        The world landmarks dominate, because only they show in which direction a finger bends. The
        image landmarks only place the hand.
        """
        settings = self.settings
        image = (self.weight * charbonnier(self._image_error(model, posed))).sum()
        data = settings.start_image_weight * image + self._world(model, posed)
        return data + self._rest(model, posed)

    def trust(self, weights: np.ndarray) -> None:
        """Multiply the weights of landmarks by (F, 21) numbers: some are hidden."""
        self.weight = self.weight * torch.as_tensor(weights, dtype=torch.float32)

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


class ContactEnergy:
    """Squared overlap of the spheres of one hand.

    Args:
        template: the hand.
        scale: m, an overlap that is still ordinary.
    """

    def __init__(self, template: HandTemplate, scale: float) -> None:
        spheres = template_spheres(template)
        pairs, distance = touching_pairs(spheres)
        self.centres = torch.as_tensor(spheres.centres, dtype=torch.float32)
        self.basis = torch.as_tensor(spheres.basis, dtype=torch.float32)
        self.joints = torch.as_tensor(spheres.joints)
        least = np.zeros((len(spheres.radii),) * 2)
        least[tuple(pairs.T)] = distance
        self.least = torch.as_tensor(least, dtype=torch.float32)
        self.scale = scale

    def __call__(self, model: ClipModel, posed: PosedClip) -> torch.Tensor:
        """Return the energy, a scalar."""
        rest = self.centres + self.basis @ model.variables.betas
        motion = posed.transforms[:, self.joints]
        places = (motion[..., :3, :3] @ rest[..., None])[..., 0] + motion[..., :3, 3]
        # Few pairs touch: find them without gradients, then treat only those.
        with torch.no_grad():
            frame, first, second = torch.nonzero(
                torch.cdist(places, places) < self.least, as_tuple=True
            )
        apart = places[frame, first] - places[frame, second]
        # A tiny length keeps the root's gradient finite for centres that meet.
        length = torch.sqrt((apart**2).sum(dim=-1) + 1e-10)
        overlap = (self.least[first, second] - length).clamp(min=0.0) / self.scale
        return (overlap**2).sum()


@dataclass(frozen=True, eq=False)
class Spheres:
    """Spheres inside a template, each moving with one joint.

    Attributes:
        centres: (K, 3) m, rest place; the mean of the vertices around it.
        basis: (K, 3, 10) m per unit of shape.
        radii: (K,) m.
        joints: (K,) int64.
        fingers: (K,) int64, index into `FINGERS`, or -1 in the palm.
        segments: (K,) int64, 0 to 2 from a finger's base; 0 in the palm.
    """

    centres: np.ndarray
    basis: np.ndarray
    radii: np.ndarray
    joints: np.ndarray
    fingers: np.ndarray
    segments: np.ndarray


def template_spheres(template: HandTemplate) -> Spheres:
    """Place spheres in slices of the fingers and of the palm."""
    owner = template.weights.argmax(axis=1)
    found: list[tuple[np.ndarray, float, int, int, int]] = []
    for finger, name in enumerate(FINGERS):
        chain = finger_joints(name)
        ends = [*template.joints[list(chain)], template.vertices[template.fingertips[finger]]]
        for segment, joint in enumerate(chain):
            start, axis = ends[segment], unit(ends[segment + 1] - ends[segment])
            members = np.flatnonzero(owner == joint)
            along = (template.vertices[members] - start) @ axis
            for part in _slices(members, along, _FINGER_SLICES):
                radial = template.vertices[part] - template.vertices[part].mean(axis=0)
                radial = radial - np.outer(radial @ axis, axis)
                radius = float(np.linalg.norm(radial, axis=1).mean())
                found.append((part, radius, joint, finger, segment))
    found += _palm_spheres(template, np.flatnonzero(owner == 0))
    parts = [part for part, *_ in found]
    return Spheres(
        centres=np.stack([template.vertices[part].mean(axis=0) for part in parts]),
        basis=np.stack([template.shape_basis[part].mean(axis=0) for part in parts]),
        radii=np.array([radius for _, radius, *_ in found]),
        joints=np.array([joint for _, _, joint, _, _ in found]),
        fingers=np.array([finger for *_, finger, _ in found]),
        segments=np.array([segment for *_, segment in found]),
    )


def touching_pairs(spheres: Spheres) -> tuple[np.ndarray, np.ndarray]:
    """Choose the pairs that must not overlap.

    Left out are neighbours: spheres of one finger, a finger's first segment with the palm, and
    the first segments of two fingers.

    Returns:
        (P, 2) int64 pairs, and (P,) m, the least distance: the firm part of both radii, or the
        distance at rest where that is smaller.
    """
    first, second = np.triu_indices(len(spheres.radii), k=1)
    base = spheres.segments == 0
    allowed = (spheres.fingers[first] != spheres.fingers[second]) & ~(base[first] & base[second])
    first, second = first[allowed], second[allowed]
    firm = FIRMNESS * (spheres.radii[first] + spheres.radii[second])
    rest = np.linalg.norm(spheres.centres[first] - spheres.centres[second], axis=1)
    return np.stack([first, second], axis=1), np.minimum(firm, rest)


def _palm_spheres(
    template: HandTemplate, members: np.ndarray
) -> list[tuple[np.ndarray, float, int, int, int]]:
    """Slices along the four metacarpals; the radius is half the palm's thickness there."""
    wrist = template.joints[0]
    knuckles = template.joints[[finger_joints(name)[0] for name in FINGERS[1:]]]
    across = palm_directions(template.joints, template.side).palmar
    rays = knuckles - wrist
    offsets = template.vertices[members] - wrist
    share = (offsets @ rays.T) / (rays**2).sum(axis=1)
    off_axis = np.linalg.norm(offsets[:, None] - share[..., None] * rays, axis=-1)
    nearest = off_axis.argmin(axis=1)
    along = share[np.arange(len(members)), nearest]
    found = []
    for ray in range(len(rays)):
        mine = (nearest == ray) & (along > 0.2)
        for part in _slices(members[mine], along[mine], _PALM_SLICES):
            height = template.vertices[part] @ across
            radius = float(np.abs(height - height.mean()).mean())
            found.append((part, radius, 0, -1, 0))
    return found


def _slices(members: np.ndarray, along: np.ndarray, count: int) -> list[np.ndarray]:
    """Divide vertices into slices of equal length along an axis."""
    if len(members) == 0:
        return []
    edges = np.linspace(along.min(), along.max() + 1e-9, count + 1)
    parts = [members[(along >= low) & (along < high)] for low, high in itertools.pairwise(edges)]
    return [part for part in parts if len(part) >= _LEAST_VERTICES]
