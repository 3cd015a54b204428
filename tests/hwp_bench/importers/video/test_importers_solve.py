"""The fit. Oracle: landmarks made from the hand model itself with known parameters."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from synthetic_clip import (
    FOCAL,
    FPS,
    HEIGHT,
    WIDTH,
    SyntheticClip,
    make_clip,
    with_correctives,
)

from hwp_bench.base.errors import DidNotConverge
from hwp_bench.hands import pose_hand
from hwp_bench.hands.poses import interpolate
from hwp_bench.hands.skinning import pose_parameters
from hwp_bench.importers.shared.frames import cut, follow_hands
from hwp_bench.importers.shared.landmarks import Landmarks, read_landmarks
from hwp_bench.importers.video.gradients import ClipEnergy
from hwp_bench.importers.video.model import (
    pose_vertices,
    rigid_start,
    unwrap_rotations,
)
from hwp_bench.importers.video.residuals import (
    OUTLINE_TURN,
    OUTLINE_WEIGHT,
    OutlineResidual,
    geman_mcclure,
    signed_distance,
)
from hwp_bench.importers.video.solve import (
    CLEAR,
    FittedClip,
    Footage,
    SideScores,
    SolveSettings,
    contradiction,
    fit_landmarks,
    refine,
    reprojection_error,
    side_scores,
)

CENTRE = np.array([WIDTH / 2, HEIGHT / 2])
SETTINGS = SolveSettings(start_steps=80, landmark_steps=200, contour_steps=60)


def fit(clip: SyntheticClip, landmarks: Landmarks, focal: float | None = FOCAL) -> FittedClip:
    footage = Footage(WIDTH, HEIGHT, FPS, focal)
    return fit_landmarks(landmarks, clip.template, footage, SETTINGS)


@functools.cache
def clean_fit() -> tuple[SyntheticClip, FittedClip]:
    clip = make_clip()
    return clip, fit(clip, clip.landmarks)


def joints(clip: SyntheticClip, fitted: FittedClip) -> np.ndarray:
    hand = fitted.model.parameters(clip.landmarks.detected)
    return pose_parameters(clip.template, hand).landmarks.numpy()


def test_the_start_of_a_rigid_hand_is_exact() -> None:
    # A hand in its rest pose is rigid, so the closed form is exact, but for the axis-angle of
    # the ray, which the synthetic tracker turns about the joints' mean and the start about the
    # pixels' mean: 2 mm and 1 degree.
    clip = make_clip(6, bend=0.0)
    rest = pose_hand(
        clip.template.to_torch(torch.float64),
        torch.zeros(1, 16, 3, dtype=torch.float64),
        torch.from_numpy(clip.hand.betas),
        torch.zeros(1, 3, dtype=torch.float64),
    ).landmarks[0]
    start = rigid_start(clip.landmarks, rest.numpy(), FOCAL, CENTRE)
    np.testing.assert_allclose(start.wrist, clip.joints[:, 0], atol=2e-3)
    truth = Rotation.from_rotvec(clip.hand.pose[:, 0])
    error = (truth.inv() * Rotation.from_matrix(start.rotation)).magnitude()
    assert np.degrees(error).max() < 1.0


def test_clean_landmarks_are_explained_to_half_a_pixel() -> None:
    clip, fitted = clean_fit()
    error = reprojection_error(fitted, clip.landmarks)
    assert error.mean < 0.5
    assert error.without_offsets < 1.5
    assert error.median <= error.percentile_95
    assert error.worst_landmark_mean >= error.mean


def test_joints_come_back_to_millimetres() -> None:
    # Relative to the wrist 5 mm on average: depth is weak. The wrist itself 3 % of its depth.
    clip, fitted = clean_fit()
    found = joints(clip, fitted)
    shape = found - found[:, :1] - (clip.joints - clip.joints[:, :1])
    assert np.linalg.norm(shape, axis=-1).mean() < 0.005
    assert np.abs(found[:, 0] - clip.joints[:, 0]).max() < 0.03 * 0.42


def test_noise_is_smoothed() -> None:
    # 2 px of noise on 320x240: the fitted track accelerates less than a third of the noisy one.
    clip = make_clip()
    rng = np.random.default_rng(0)
    image = clip.landmarks.image + rng.normal(0, 2, clip.landmarks.image.shape)
    world = clip.landmarks.world + rng.normal(0, 0.004, clip.landmarks.world.shape)
    fitted = fit(clip, replace(clip.landmarks, image=image, world=world))
    with torch.no_grad():
        track = fitted.model.pixels(fitted.model.pose().landmarks).numpy()
    assert np.abs(np.diff(track, 2, axis=0)).mean() < np.abs(np.diff(image, 2, axis=0)).mean() / 3
    assert np.linalg.norm(track - clip.landmarks.image, axis=-1).mean() < 2.0


def test_gaps_and_outliers_do_no_harm() -> None:
    clip = make_clip()
    image, detected = clip.landmarks.image.copy(), clip.landmarks.detected.copy()
    detected[[0, 12, 13, 14, 29]] = False
    image[~detected] = 0.0
    image[20, 8] += 60.0
    image[6] += np.random.default_rng(0).normal(0, 25, (21, 2))
    broken = replace(clip.landmarks, image=image, detected=detected)
    fitted = fit(clip, broken)
    hand = fitted.model.parameters(detected)
    assert np.isfinite(hand.pose).all()
    assert np.isfinite(hand.transl).all()
    with torch.no_grad():
        track = fitted.model.pixels(fitted.model.pose().landmarks).numpy()
    error = np.linalg.norm(track - clip.landmarks.image, axis=-1).mean(axis=1)
    # The gap of three frames is bridged, and one finger tip that jumps is ignored.
    assert error[12:15].max() < 6.0
    assert error[20] < 2.0
    assert np.isnan(reprojection_error(fitted, broken).by_frame[~detected]).all()


def test_the_focal_length_is_estimated_near_the_likely_one() -> None:
    # Without a focal length the prior is 0.8 of the width: 256 px where the truth is 260.
    clip = make_clip()
    focal = float(fit(clip, clip.landmarks, focal=None).model.focal.detach())
    assert 0.8 < focal / FOCAL < 1.2
    assert float(clean_fit()[1].model.focal.detach()) == pytest.approx(FOCAL, rel=1e-6)


def test_a_left_hand_is_fitted_by_the_left_template() -> None:
    clip = make_clip(side="left")
    assert reprojection_error(fit(clip, clip.landmarks), clip.landmarks).mean < 0.7


def test_the_fit_repeats_exactly_and_gives_torchs_threads_back() -> None:
    before = torch.get_num_threads()
    clip, few = make_clip(6), SolveSettings(start_steps=8, landmark_steps=8)
    footage = Footage(WIDTH, HEIGHT, FPS, FOCAL)
    first, second = (fit_landmarks(clip.landmarks, clip.template, footage, few) for _ in range(2))
    ours, theirs = (f.model.parameters(clip.landmarks.detected) for f in (first, second))
    np.testing.assert_array_equal(ours.pose, theirs.pose)
    np.testing.assert_array_equal(ours.transl, theirs.transl)
    assert torch.get_num_threads() == before


def test_a_fit_that_leaves_the_numbers_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hwp_bench.importers.video.residuals.WORLD_SCALE", 1e-200)
    clip = make_clip(4)
    settings = SolveSettings(start_steps=2)
    with pytest.raises(DidNotConverge):
        fit_landmarks(clip.landmarks, clip.template, Footage(WIDTH, HEIGHT, FPS, FOCAL), settings)


def test_rotation_vectors_do_not_jump() -> None:
    # A steady turn through a full circle: the vector grows past pi instead of flipping.
    angles = np.linspace(0.2, 2 * np.pi - 0.2, 40)
    axis = np.array([0.6, 0.8, 0.0])
    truth = angles[:, None] * axis
    rotations = Rotation.from_rotvec(truth).as_matrix()
    np.testing.assert_allclose(unwrap_rotations(rotations), truth, atol=1e-9)


def test_interpolation_holds_the_ends() -> None:
    values = interpolate(np.array([[1.0], [3.0]]), np.array([1, 3]), 6)
    np.testing.assert_allclose(values[:, 0], [1, 1, 2, 3, 3, 3])


@pytest.mark.parametrize("correctives", [False, True])
def test_outline_vertices_are_those_of_the_hand_model(correctives: bool) -> None:
    # The energy poses a few vertices by itself; `pose_vertices` poses all, in float32: 1e-4.
    clip = make_clip(4)
    hand = with_correctives(clip.template) if correctives else clip.template
    footage = Footage(WIDTH, HEIGHT, FPS, FOCAL)
    quick = SolveSettings(start_steps=20, landmark_steps=1)
    fitted = fit_landmarks(clip.landmarks, hand, footage, quick)
    windows = follow_hands([clip.landmarks], FPS, 96)
    masks = [
        cut(clip.silhouette(frame), windows.corners[frame], windows.side) for frame in range(4)
    ]
    fields = np.stack([signed_distance(mask) for mask in masks])
    contour = OutlineResidual(fields, clip.landmarks.detected, windows, 150.0)
    contour.rematch(fitted.model)
    matched, terms = contour.outlines, fitted.landmarks
    with torch.no_grad():
        pixels = fitted.model.pixels(torch.as_tensor(pose_vertices(fitted.model))).numpy()
    chosen = np.take_along_axis(pixels, matched.vertices[..., None], axis=1)
    field = (chosen - matched.corners[:, None]) * matched.ratio
    away = ((field * matched.normal).sum(axis=2) - matched.target) / matched.scale
    values, _ = geman_mcclure(away**2, OUTLINE_TURN)
    with_outline, _ = ClipEnergy(terms, contour).differentiate(fitted.model)
    without, _ = ClipEnergy(terms).differentiate(fitted.model)
    assert values.sum() > 1.0
    expected = OUTLINE_WEIGHT * values.sum()
    assert with_outline - without == pytest.approx(expected, rel=1e-4)


def test_the_outline_pulls_a_displaced_hand_back() -> None:
    # Landmarks 5 px to the right of the hand; the masks are where the hand is.
    clip = make_clip(6)
    shifted = clip.landmarks.image + np.array([5.0, 0.0])
    fitted = fit(clip, replace(clip.landmarks, image=shifted))
    windows = follow_hands([clip.landmarks], FPS, 96)
    fields = np.stack(
        [
            signed_distance(cut(clip.silhouette(f), windows.corners[f], windows.side))
            for f in range(6)
        ]
    )
    contour = OutlineResidual(fields, clip.landmarks.detected, windows, 150.0)

    def offset() -> float:
        with torch.no_grad():
            pixels = fitted.model.pixels(torch.as_tensor(pose_vertices(fitted.model))).numpy()
        return float(np.abs((pixels - clip.vertex_pixels).mean(axis=(0, 1)))[0])

    before = offset()
    refine(fitted, contour)
    assert before > 3.5
    assert offset() < before / 2


REAL = Path(__file__).resolve().parents[5] / "shared" / "data" / "real_hand"
FOOTAGE = Footage(WIDTH, HEIGHT, FPS, None)


def noisy(landmarks: Landmarks) -> Landmarks:
    """Errors of 4 mm and 1.5 px, as a tracker's."""
    random = np.random.default_rng(3)
    image = landmarks.image + random.normal(0, 1.5, landmarks.image.shape)
    world = landmarks.world + random.normal(0, 0.004, landmarks.world.shape)
    return replace(landmarks, image=image, world=world)


@pytest.mark.parametrize("side", ["right", "left"])
def test_simulated_hands_of_both_sides(side: str) -> None:
    other = "left" if side == "right" else "right"
    scores = side_scores(noisy(make_clip(10, side=side).landmarks), "anny", FOOTAGE)
    assert scores.frames == 10
    assert scores.better == side
    # Noise alone leaves 4 mm in each of three directions, 7 mm; the wrong side adds bends.
    assert getattr(scores, side) < 0.008
    assert getattr(scores, other) > 1.3 * getattr(scores, side)


def test_frames_without_a_hand_do_not_count() -> None:
    clip = make_clip(8).landmarks
    seen = np.arange(8) % 2 == 0
    landmarks = Landmarks(
        np.where(seen[:, None, None], clip.image, 0.0),
        np.where(seen[:, None, None], clip.world, 0.0),
        np.where(seen, 1.0, 0.0),
        seen,
    )
    scores = side_scores(landmarks, "anny", FOOTAGE)
    assert (scores.frames, scores.better) == (4, "right")


@pytest.mark.parametrize(
    ("stated", "scores", "votes", "warned"),
    [
        ("left", (0.005, 0.010), {"right": 0.95, "left": 0.05}, True),
        ("right", (0.005, 0.010), {"right": 0.95, "left": 0.05}, False),
        # The fit is clear, the votes err.
        ("right", (0.005, 0.010), {"right": 0.4, "left": 0.6}, False),
        ("left", (0.005, 0.010), {"right": 0.4, "left": 0.6}, True),
        # The fit is not clear: the votes decide, where there are any.
        ("left", (0.010, 0.010 * CLEAR), {"right": 0.9, "left": 0.1}, True),
        ("left", (0.010, 0.010 * CLEAR), None, False),
        ("left", (0.005, 0.010), None, True),
    ],
)
def test_a_contradiction_is_said_with_both_scores(
    stated: str,
    scores: tuple[float, float],
    votes: dict[str, float] | None,
    warned: bool,
) -> None:
    said = contradiction(stated, SideScores(*scores, 12), votes)
    assert (said is not None) is warned
    if said is not None:
        assert f"is said to be a {stated} one" in said
        assert f"{1e3 * scores[0]:.1f} mm as a right hand" in said
        assert f"{1e3 * scores[1]:.1f} mm as a left one (12 frames)" in said
        assert ("votes right" in said) is (votes is not None)


def test_a_real_right_hand() -> None:
    if not REAL.is_dir():
        pytest.skip("the real video is not here")
    landmarks = read_landmarks(REAL / "landmarks.npz", min_score=0.5)
    scores = side_scores(landmarks, "anny", Footage(1280, 720, 30.0, None))
    assert scores.better == "right"
    assert scores.left > 1.5 * scores.right
