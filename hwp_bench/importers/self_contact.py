"""Keeping fingers out of each other and out of the palm, with a few spheres inside the hand."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.hands import HandTemplate
from hwp_bench.hands.landmarks import FINGERS, finger_joints
from hwp_bench.hands.palm import palm_directions, unit
from hwp_bench.importers.clip_model import ClipModel, PosedClip

#: Share of the radii that counts: skin and flesh give way.
FIRMNESS = 0.85
# Slices along each finger segment and along each metacarpal.
_FINGER_SLICES = 2
_PALM_SLICES = 3
# A sphere of fewer vertices says nothing about thickness.
_LEAST_VERTICES = 4


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
    beside = np.linalg.norm(offsets[:, None] - share[..., None] * rays, axis=-1)
    nearest = beside.argmin(axis=1)
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
