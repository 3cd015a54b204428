"""Fingers in fingers. Oracle: poses of which anyone can say whether they penetrate."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from synthetic_clip import FOCAL, HEIGHT, WIDTH, make_clip, template

from hwp_bench.hands.articulation import joint_axes
from hwp_bench.importers.video.model import ClipModel, RigidStart
from hwp_bench.importers.video.residuals import ContactResidual, template_spheres, touching_pairs


def model(side: str, fingers: np.ndarray) -> ClipModel:
    frames = len(fingers)
    start = RigidStart(
        np.tile(np.eye(3), (frames, 1, 1)),
        np.tile([0.0, 0.0, 0.5], (frames, 1)),
        np.zeros((frames, 21, 3)),
    )
    made = ClipModel(template(side), start, FOCAL, np.array([WIDTH / 2, HEIGHT / 2]))
    with torch.no_grad():
        made.variables.fingers.copy_(torch.as_tensor(fingers, dtype=torch.float32))
    return made


@pytest.mark.parametrize("side", ["right", "left"])
def test_rest_is_free_and_a_crossing_finger_is_not(side: str) -> None:
    axes = joint_axes(template(side))
    poses = np.zeros((3, 15, 3))
    # The index finger sideways through the middle finger; the ring finger through the palm.
    poses[1, 0] = -0.6 * axes[0, :, 1]
    poses[2, 9:12] = 2.0 * axes[9:12, :, 0]
    energies = []
    for pose in poses:
        clip = model(side, pose[None])
        energies.append(ContactResidual(template(side))(clip, clip.posed()))
    assert float(energies[0].detach()) < 5e-7
    assert float(energies[1].detach()) > 5
    assert float(energies[2].detach()) > 5


def test_gradients_are_finite_where_centres_meet() -> None:
    clip = model("right", np.zeros((1, 15, 3)))
    contact = ContactResidual(template())
    contact.least.fill_(0.01)  # every sphere touches itself
    contact(clip, clip.posed()).backward()
    assert clip.variables.fingers.grad is not None
    assert torch.isfinite(clip.variables.fingers.grad).all()


def test_spheres_lie_inside_the_hand() -> None:
    hand = template()
    spheres = template_spheres(hand)
    assert 30 <= len(spheres.radii) <= 45
    assert spheres.radii.min() > 0
    assert spheres.radii.max() < 0.02
    low, high = hand.vertices.min(axis=0), hand.vertices.max(axis=0)
    assert ((spheres.centres > low) & (spheres.centres < high)).all()
    pairs, distance = touching_pairs(spheres)
    assert (spheres.fingers[pairs[:, 0]] != spheres.fingers[pairs[:, 1]]).all()
    assert (distance > 0).all()


def test_the_fist_of_a_synthetic_clip_costs_little() -> None:
    # An ordinary closing hand must not be fought: below one ordinary overlap a frame.
    known = make_clip(5, bend=0.5)
    clip = model("right", known.hand.pose[:, 1:])
    assert float(ContactResidual(template())(clip, clip.posed()).detach()) < 2.5
