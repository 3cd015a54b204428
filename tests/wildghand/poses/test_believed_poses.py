"""The poses that a fit believes in. Oracles: true poses, finite differences, the errors put in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hwp_bench.capture import Cameras
from hwp_bench.hands import HandParameters, load_template
from hwp_bench.hands.poses import posed_skeleton, rest_skeleton, turned
from wildghand.poses import ClipPoses, believe, believed_hands
from wildghand.poses.believe import _rows
from wildghand.poses.errors import (
    error_size,
    extent_in,
    pose_covariances,
    spread_of,
    vector_changes,
)

FRAMES = 80
TEMPLATE = load_template("anny", "right")


def _cameras(frames: int) -> Cameras:
    K = np.array([[250.0, 0.0, 88.0], [0.0, 250.0, 88.0], [0.0, 0.0, 1.0]])
    return Cameras(np.tile(K, (frames, 1, 1)), np.tile(np.eye(4), (frames, 1, 1)))


def _truth(seed: int = 0, frames: int = FRAMES) -> HandParameters:
    """A hand that moves in five ways, and turns before the camera."""
    rng = np.random.default_rng(seed)
    ways = 0.35 * rng.normal(size=(5, 45))
    fingers = 0.2 * rng.normal(size=45) + rng.normal(size=(frames, 5)) @ ways / 2.0
    pose = np.zeros((frames, 16, 3))
    pose[:, 1:] = fingers.reshape(frames, 15, 3)
    pose[:, 0] = rng.normal(0.0, 0.6, (frames, 3))
    transl = np.array([0.0, 0.0, 0.45]) + rng.normal(0.0, 0.02, (frames, 3))
    return HandParameters(pose, np.zeros(10), transl, np.ones(frames, dtype=bool))


def _covariances(hand: HandParameters) -> np.ndarray:
    viewmats = _cameras(len(hand.pose)).viewmats
    extent = extent_in(TEMPLATE, hand, viewmats)
    return pose_covariances(TEMPLATE, hand, viewmats, extent)


def _with_errors(truth: HandParameters, size: float, seed: int = 1) -> HandParameters:
    """The hand as an estimator that goes by landmarks gives it."""
    rng = np.random.default_rng(seed)
    frames = truth.frame_count
    covariances = _covariances(truth)
    roots = np.linalg.cholesky(covariances + 1e-10 * np.eye(51))
    errors = size * (roots @ rng.normal(size=(frames, 51, 1)))[..., 0]
    pose = turned(truth.pose, errors[:, :48].reshape(-1, 16, 3))
    return replace(truth, pose=pose, transl=truth.transl + errors[:, 48:])


def _believed(
    hand: HandParameters, exact: np.ndarray | None = None, **changes: float
) -> HandParameters:
    """With some of the constants changed."""
    cameras = _cameras(hand.frame_count)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in changes.items():
            patch.setattr(believe, name, value)
        return believed_hands({"right": TEMPLATE}, {"right": hand}, cameras, exact)["right"]


def _turns(hand: HandParameters, truth: HandParameters) -> float:
    """Root mean square error of the finger joints, rad."""
    found, true = (Rotation.from_rotvec(one.pose[:, 1:].reshape(-1, 3)) for one in (hand, truth))
    return float(np.sqrt(np.square((true.inv() * found).as_rotvec()).mean()))


def _pixels(hand: HandParameters, truth: HandParameters) -> float:
    """Root mean square distance of the landmarks in the image, px."""
    rest, image = rest_skeleton(TEMPLATE, hand.betas), []
    for one in (hand, truth):
        points = posed_skeleton(rest, one.pose, one.transl).landmarks
        image.append(250.0 * points[..., :2] / points[..., 2:])
    return float(np.sqrt(np.square(image[0] - image[1]).sum(axis=-1).mean()))


@pytest.mark.parametrize("size", [0.5, 1.0, 2.0])
def test_errors_of_a_hand_that_moves_in_few_ways_are_taken_away(size: float) -> None:
    truth = _truth()
    given = _with_errors(truth, size)
    found = _believed(given)
    assert _turns(found, truth) < 0.6 * _turns(given, truth)
    assert _pixels(found, truth) < 0.85 * _pixels(given, truth)


def test_exact_poses_stay_as_they_are() -> None:
    truth = _truth()
    # Five ways of moving leave forty directions that nothing moves along.
    assert _believed(truth) is truth


@pytest.mark.parametrize("share", [0.2, 0.6])
def test_frames_of_true_poses_stay_and_the_others_are_corrected_as_well(share: float) -> None:
    # Oracle: the truth; and the correction of the same frames without the true ones.
    truth = _truth(frames=300)
    given = _with_errors(truth, 1.0)
    exact = np.random.default_rng(2).random(300) < share
    mixed = replace(given, pose=np.where(exact[:, None, None], truth.pose, given.pose))
    mixed = replace(mixed, transl=np.where(exact[:, None], truth.transl, given.transl))
    found = _believed(mixed, exact)
    np.testing.assert_array_equal(found.pose[exact], truth.pose[exact])
    np.testing.assert_array_equal(found.transl[exact], truth.transl[exact])

    def error(hand: HandParameters) -> float:
        return _turns(_rows(hand, ~exact), _rows(truth, ~exact))

    assert error(found) < 0.6 * error(given)
    assert error(found) <= 1.02 * error(_believed(given))


def test_small_errors_are_left_alone() -> None:
    given = _with_errors(_truth(), 0.05)
    assert _believed(given) is given
    assert _believed(given, LEAST_ERROR=0.0) is not given


@pytest.mark.parametrize("frames", [3, 45, 46])
def test_few_frames_tell_nothing(frames: int) -> None:
    given = _with_errors(_truth(frames=frames), 1.0)
    assert _believed(given) is given


def test_frames_without_the_hand_keep_their_numbers() -> None:
    given = _with_errors(_truth(), 1.0)
    valid = given.valid.copy()
    valid[[0, 7]] = False
    given = replace(given, valid=valid)
    found = _believed(given)
    np.testing.assert_array_equal(found.pose[[0, 7]], given.pose[[0, 7]])
    np.testing.assert_array_equal(found.transl[~valid], given.transl[~valid])
    assert (found.pose[valid] != given.pose[valid]).any()


def test_a_pose_that_is_held_after_the_hand_was_lost_is_corrected() -> None:
    """As importers fill frames without the hand: they hold the last pose."""
    given, last = _with_errors(_truth(), 1.0), FRAMES - 4
    pose, transl, valid = given.pose.copy(), given.transl.copy(), given.valid.copy()
    pose[last + 1 :], transl[last + 1 :], valid[last + 1 :] = pose[last], transl[last], False
    given = replace(given, pose=pose, transl=transl, valid=valid)
    believed = _believed(given)
    poses = ClipPoses.of({"right": given}, {"right": believed})
    assert poses is not None
    for frame in (last, FRAMES - 1):
        told = poses.corrected({"right": given.at(frame, "right")})["right"]
        np.testing.assert_allclose(told.pose, believed.pose[last], atol=1e-6)
        np.testing.assert_allclose(told.transl, believed.transl[last], atol=1e-6)
    assert np.abs(believed.pose[last] - given.pose[last]).max() > 1e-3


def test_a_frame_is_corrected_alike_whichever_frames_come_with_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Oracle: all frames at once. The hand of the second half is twice as far away."""
    truth = _truth(frames=2 * FRAMES)
    truth.transl[FRAMES:, 2] *= 2.0
    given = _with_errors(truth, 1.0)
    expected = _believed(given)
    monkeypatch.setattr(believe, "_CHUNK", 32)
    found = _believed(given)
    assert not np.array_equal(found.pose, given.pose)
    np.testing.assert_allclose(found.pose, expected.pose, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.transl, expected.transl, rtol=0, atol=1e-9)


def test_a_long_clip_is_corrected_in_all_of_its_frames() -> None:
    truth = _truth(frames=300)
    given = _with_errors(truth, 1.0)
    found = _believed(given, FRAMES=100)
    assert _turns(found, truth) < 0.6 * _turns(given, truth)
    assert (found.pose != given.pose).any(axis=(1, 2)).all()


def test_the_order_of_frames_does_not_matter() -> None:
    given = _with_errors(_truth(), 1.0)
    order = np.random.default_rng(5).permutation(FRAMES)
    mixed = replace(given, pose=given.pose[order], transl=given.transl[order])
    # Sums in another order; the covariance is inverted with a condition of up to 1e6.
    np.testing.assert_allclose(_believed(mixed).pose, _believed(given).pose[order], atol=1e-6)


def test_the_same_pose_in_every_frame_is_kept() -> None:
    truth = _truth()
    still = replace(truth, pose=np.tile(truth.pose[:1], (FRAMES, 1, 1)))
    assert _believed(still) is still


def test_whole_turns_of_a_joint_change_nothing() -> None:
    given = _with_errors(_truth(), 1.0)
    pose = given.pose.copy()
    length = np.linalg.norm(pose[::3, 4], axis=1, keepdims=True)
    pose[::3, 4] *= 1.0 + 2.0 * np.pi / length
    found, told = _believed(replace(given, pose=pose)), _believed(given)
    assert _turns(found, told) < 1e-6


def test_a_hand_behind_the_camera_is_left_alone() -> None:
    given = _with_errors(_truth(), 1.0)
    transl = given.transl.copy()
    transl[3:6, 2] = [-0.4, -0.3, -0.2]
    given = replace(given, transl=transl)
    found = _believed(given)
    np.testing.assert_array_equal(found.pose[3:6], given.pose[3:6])
    assert np.isfinite(found.pose).all()
    assert (found.pose[6:] != given.pose[6:]).any()
    away = replace(given, transl=-np.abs(transl))
    assert _believed(away) is away


@pytest.mark.parametrize("size", [1e6, 2.0 * np.pi, np.pi])
def test_poses_of_any_length_are_finite(size: float) -> None:
    rng = np.random.default_rng(0)
    pose = rng.normal(size=(FRAMES, 16, 3))
    pose *= size / np.linalg.norm(pose, axis=-1, keepdims=True)
    found = _believed(replace(_truth(), pose=pose))
    assert np.isfinite(found.pose).all()
    far = replace(_truth(), pose=pose, transl=np.tile([1e6, -1e6, 1e6], (FRAMES, 1)))
    assert np.isfinite(_believed(far).pose).all()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_corrected_poses_are_finite_and_near(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size, reach = np.exp(rng.uniform(-3.0, 3.0)), np.exp(rng.uniform(-3.0, 1.0))
    truth = _truth(seed)
    wild = replace(truth, pose=truth.pose * reach)
    found = _believed(_with_errors(wild, size, seed))
    assert np.isfinite(found.pose).all()
    assert np.isfinite(found.transl).all()


@pytest.mark.parametrize("size", [0.3, 1.0, 3.0])
def test_the_size_of_errors_is_found(size: float) -> None:
    rng = np.random.default_rng(0)
    errors = np.array([np.diag(rng.uniform(0.5, 2.0, 20)) for _ in range(200)])
    poses = rng.normal(size=(200, 3)) @ (5.0 * rng.normal(size=(3, 20)))
    poses += size * np.sqrt(np.diagonal(errors, axis1=1, axis2=2)) * rng.normal(size=(200, 20))
    # 200 frames of 17 directions: the variance is known to 2.4 % (one standard deviation).
    assert error_size(poses, errors) == pytest.approx(size, rel=0.05)


def test_the_spread_of_true_poses_is_found() -> None:
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(6, 6))
    true = rng.normal(size=(4000, 6)) @ ways + 2.0
    errors = np.array([np.diag(rng.uniform(0.2, 2.0, 6)) for _ in range(len(true))])
    given = true + np.sqrt(np.diagonal(errors, axis1=1, axis2=2)) * rng.normal(size=true.shape)
    found = spread_of(given, errors, 60)
    # 4,000 poses know a covariance to about 3 % of its largest number.
    np.testing.assert_allclose(found.mean, np.full(6, 2.0), atol=0.15)
    scale = np.abs(ways.T @ ways).max()
    np.testing.assert_allclose(found.covariance, ways.T @ ways, atol=0.06 * scale)
    # The expected poses are nearer than the given ones, and as far off as theory says.
    off = np.square(found.expected(given, errors) - true).mean()
    prior = ways.T @ ways
    theory = np.mean([np.trace(prior - prior @ np.linalg.inv(prior + e) @ prior) for e in errors])
    assert off == pytest.approx(theory / 6, rel=0.05)


@pytest.mark.parametrize("length", [1e-6, 0.3, 2.0, np.pi])
def test_vectors_change_as_finite_differences_say(length: float) -> None:
    rng = np.random.default_rng(3)
    vector = rng.normal(size=3)
    vector *= length / np.linalg.norm(vector)
    step, numeric = 1e-6, np.empty((3, 3))
    for axis in range(3):
        ends = []
        for sign in (1.0, -1.0):
            turn = (sign * step * np.eye(3)[axis])[None, None]
            ends.append(turned(vector[None, None], turn)[0, 0])
        numeric[:, axis] = (ends[0] - ends[1]) / (2.0 * step)
    np.testing.assert_allclose(vector_changes(vector), numeric, atol=1e-4)


def test_the_joints_of_a_finger_make_up_for_each_other() -> None:
    """As the importer's errors do on simulated clips (docs/simulation.md): -0.4 for neighbours."""
    truth = replace(_truth(), pose=np.zeros((FRAMES, 16, 3)))
    covariances = _covariances(truth)
    flexion = [3 * joint + 2 for joint in (1, 2, 3)]
    part = covariances[0][np.ix_(flexion, flexion)]
    deviations = np.sqrt(np.diag(part))
    correlation = part / np.outer(deviations, deviations)
    assert correlation[0, 1] < -0.2
    assert correlation[1, 2] < -0.2


def test_a_pose_of_the_clip_is_told_by_its_numbers() -> None:
    given = _with_errors(_truth(), 1.0)
    believed = _believed(given)
    poses = ClipPoses.of({"right": given}, {"right": believed})
    assert poses is not None
    told = poses.corrected({"right": given.at(3, "right")})["right"]
    np.testing.assert_allclose(told.pose, believed.pose[3], atol=1e-6)
    np.testing.assert_allclose(told.transl, believed.transl[3], atol=1e-6)
    other = replace(given.at(3, "right"), pose=given.pose[3] + 1e-5)
    assert poses.corrected({"right": other})["right"] is other
    assert poses.corrected({"right": told})["right"] is told
    left = replace(given.at(3, "right"), side="left")
    assert poses.corrected({"left": left})["left"] is left


def test_a_clip_without_corrections_is_not_remembered() -> None:
    truth = {"right": _truth()}
    assert ClipPoses.of(truth, truth) is None
    assert ClipPoses.from_tensors({}, "file") is None


def test_remembered_poses_are_read_as_written() -> None:
    given = _with_errors(_truth(), 1.0)
    poses = ClipPoses.of({"right": given}, {"right": _believed(given)})
    assert poses is not None
    again = ClipPoses.from_tensors(poses.to_tensors(), "file")
    assert again is not None
    for hand in (given.at(0, "right"), _truth().at(0, "right")):
        first, second = (one.corrected({"right": hand})["right"] for one in (poses, again))
        np.testing.assert_array_equal(first.pose, second.pose)
