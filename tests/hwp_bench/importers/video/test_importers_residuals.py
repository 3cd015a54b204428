"""Residuals without pictures. Oracles: distances of circles; hands that plainly penetrate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic_clip import FOCAL, HEIGHT, WIDTH, disc, make_clip, template

from hwp_bench.hands.articulation import joint_axes
from hwp_bench.hands.template import boundary_vertices
from hwp_bench.importers.video.gradients import ClipEnergy
from hwp_bench.importers.video.masks import behind_wrist
from hwp_bench.importers.video.model import ClipModel, RigidStart
from hwp_bench.importers.video.residuals import (
    FIELD_SIZE,
    LandmarkResidual,
    acceleration_weights,
    match_outline,
    signed_distance,
    template_spheres,
    touching_pairs,
)


def test_acceleration_knows_the_time_between_frames() -> None:
    """Of a parabola it is the same everywhere, whatever the steps; of a line it is 0."""
    steps = np.array([1.0, 1.05, 2.0, 1.0, 0.5, 3.0])
    time = np.cumsum([0.0, *steps])
    bend, slope = np.array([0.3, -0.2]), np.array([2.0, 5.0])
    track = (0.5 * np.outer(time**2, bend) + np.outer(time, slope) + 1.0)[:, None]
    first, middle, last = acceleration_weights(steps, 0.1)
    found = first * track[:-2] + middle * track[1:-1] + last * track[2:]
    np.testing.assert_allclose(found, np.tile(bend / 0.1, (5, 1, 1)), atol=1e-12)
    # Of even steps it is the second difference.
    for weight, share in zip(
        acceleration_weights(np.full(6, 30.0 / 24.0), 0.1), (1, -2, 1), strict=True
    ):
        np.testing.assert_allclose(weight, share / (0.1 * (30.0 / 24.0) ** 2), rtol=1e-15)


def disc_mask(centre: np.ndarray, radius: float, size: int = FIELD_SIZE) -> np.ndarray:
    rows, columns = np.mgrid[:size, :size] + 0.5
    inside = (columns - centre[0]) ** 2 + (rows - centre[1]) ** 2 < radius**2
    return (inside * 255).astype(np.uint8)


def test_the_signed_distance_of_a_disc() -> None:
    # Exact but for the staircase of the mask: 0.75 px.
    centre, radius = np.array([90.0, 100.0]), 40.0
    rows, columns = np.mgrid[:FIELD_SIZE, :FIELD_SIZE] + 0.5
    truth = np.hypot(columns - centre[0], rows - centre[1]) - radius
    field = signed_distance(disc_mask(centre, radius)).astype(float)
    # Deep inside the nearest outline pixel is a matter of taste; float16 adds a little.
    np.testing.assert_allclose(field, truth, atol=0.75)


def test_a_hand_that_another_covers_has_no_outline() -> None:
    centre = np.array([96.0, 96.0])
    vertices, faces = disc(centre, 40.0)
    field = signed_distance(disc_mask(centre, 40.0))
    found = match_outline(vertices, faces, np.zeros(0, dtype=np.int64), field, reach=8.0)
    assert not found.normal.any()
    assert not found.target.any()


@pytest.mark.parametrize("level", [0, 255])
def test_a_mask_without_outline_has_no_field(level: int) -> None:
    assert not signed_distance(np.full((64, 64), level, dtype=np.uint8)).any()


@pytest.mark.parametrize("growth", [-4.0, 0.0, 3.0, 5.0])
def test_outline_vertices_are_drawn_along_their_normals(growth: float) -> None:
    centre, radius = np.array([96.0, 96.0]), 40.0
    vertices, faces = disc(centre, radius)
    field = signed_distance(disc_mask(centre, radius + growth))
    found = match_outline(vertices, faces, np.arange(len(vertices)), field, reach=8.0)
    used = np.abs(found.normal).sum(axis=1) > 0
    assert used.sum() == len(vertices) - 1  # all but the centre
    outward = (vertices[found.index] - centre) / radius
    assert (found.normal * outward).sum(axis=1)[used].min() > 0.98
    way = found.target - (found.normal * vertices[found.index]).sum(axis=1)
    assert abs(way[used].mean() - growth) < 0.3
    assert np.abs(way[used] - growth).max() < 1.0


def test_a_side_never_snaps_to_the_opposite_side() -> None:
    # The mask is a ring whose hole begins 3 px inside the mesh's outline: nearest to a vertex
    # is the hole's edge, but that faces inwards.
    centre = np.array([96.0, 96.0])
    vertices, faces = disc(centre, 40.0)
    ring = disc_mask(centre, 45.0) - disc_mask(centre, 37.0)
    field = signed_distance(ring)
    found = match_outline(vertices, faces, np.arange(len(vertices)), field, reach=8.0)
    used = np.abs(found.normal).sum(axis=1) > 0
    way = found.target - (found.normal * vertices[found.index]).sum(axis=1)
    assert used.any()
    assert np.abs(way[used] - 5.0).max() < 1.0


def test_out_of_reach_means_no_pull() -> None:
    vertices, faces = disc(np.array([60.0, 60.0]), 20.0)
    field = signed_distance(disc_mask(np.array([150.0, 150.0]), 20.0))
    found = match_outline(vertices, faces, np.arange(len(vertices)), field, reach=8.0)
    assert not found.normal.any()
    assert not found.target.any()


def test_the_forearm_lies_beyond_the_wrist() -> None:
    clip = make_clip(3)
    ring = boundary_vertices(clip.template.faces)
    for frame in range(3):
        pixels = clip.vertex_pixels[frame]
        behind = behind_wrist(clip.vertices[frame], pixels, ring, 320)
        x, y = clip.landmarks.image[frame, 9].astype(int)
        assert behind[y, x] < 0
        wrist = pixels[ring].mean(axis=0)
        x, y = (wrist + 0.4 * (wrist - clip.landmarks.image[frame, 9])).astype(int)
        assert behind[y, x] > 0
    assert (behind_wrist(clip.vertices[0], pixels, ring[:2], 320) < 0).all()


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


def untracked(clip: ClipModel) -> LandmarkResidual:
    """Residuals of a clip whose landmarks have no weight."""
    tracked = make_clip(len(clip.start)).landmarks
    unsure = replace(tracked, score=np.zeros(len(clip.start)))
    return LandmarkResidual(unsure, clip, None, None)


def contact_energy(clip: ClipModel) -> float:
    """What the energy loses where spheres may come as near as they like."""
    terms = untracked(clip)
    everything, _ = ClipEnergy(terms).differentiate(clip)
    terms.least[:] = 0.0
    return everything - ClipEnergy(terms).differentiate(clip)[0]


@pytest.mark.parametrize("side", ["right", "left"])
def test_rest_is_free_and_a_crossing_finger_is_not(side: str) -> None:
    axes = joint_axes(template(side))
    poses = np.zeros((3, 15, 3))
    # The index finger sideways through the middle finger; the ring finger through the palm.
    poses[1, 0] = -0.6 * axes[0, :, 1]
    poses[2, 9:12] = 2.0 * axes[9:12, :, 0]
    free, crossing, through = (contact_energy(model(side, pose[None])) for pose in poses)
    assert abs(free) < 5e-7
    assert crossing > 5
    assert through > 5


def test_gradients_are_finite_where_centres_meet() -> None:
    clip = model("right", np.zeros((1, 15, 3)))
    terms = untracked(clip)
    terms.contact.joints[:] = 0
    terms.contact.centres[:] = clip.template.joints[0]
    terms.contact.basis[:] = 0.0
    value, slopes = ClipEnergy(terms).differentiate(clip)
    assert np.isfinite(value)
    for slope in slopes.values():
        assert np.isfinite(slope).all()


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
    assert contact_energy(clip) < 2.5
