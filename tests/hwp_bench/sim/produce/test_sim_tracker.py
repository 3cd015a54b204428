"""A tracker's errors. Oracles: the stated correlation, errors that are mixed.

That they are those of a real tracker is `benchmarks/tracker_errors.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tiny_scene import SceneMaker

from hwp_bench.hands import load_template
from hwp_bench.hands.poses import RestSkeleton, posed_skeleton, rest_skeleton, turned
from hwp_bench.sim.effects import plan_frame
from hwp_bench.sim.produce.capture import true_hands
from hwp_bench.sim.produce.estimates import (
    MEMORY,
    TRACKER_HABIT,
    ParameterErrors,
    curl,
    edge_on,
    estimate_hands,
    growth,
    landmark_noise,
    parameter_errors,
    wandering,
)
from hwp_bench.sim.scene.scene import (
    Estimator,
    HandKey,
    hand_parameters,
    moment_of_key,
    with_effects,
)

FRAMES = 60


def _hand(side: str = "right") -> RestSkeleton:
    betas = np.random.default_rng(4).normal(0.0, 0.7, 10)
    return rest_skeleton(load_template("anny", side), betas)


def _held(count: int, gesture: str, turn: float = 180.0) -> tuple[np.ndarray, np.ndarray]:
    """Pose and transl of a right hand before the camera, the same in all frames.

    Args:
        count: frames.
        gesture: its fingers.
        turn: about the fingers' direction, degrees; 180 shows the palm.
    """
    moment = moment_of_key(HandKey(gesture, turn=turn))
    pose, transl = hand_parameters(moment, "right", _hand().joints)
    return np.tile(pose, (count, 1, 1)), np.tile(transl, (count, 1))


def _errors(count: int, gesture: str, turn: float = 180.0) -> ParameterErrors:
    pose, transl = _held(count, gesture, turn)
    views = np.tile(np.eye(4), (count, 1, 1))
    # Far apart in time, so that every frame is a draw of its own.
    noise = landmark_noise(np.random.default_rng(0), count, 10.0, habit=0.0)
    return parameter_errors(_hand(), pose, transl, views, noise)


@pytest.mark.parametrize("step", [1 / 60, 1 / 30, 0.2])
def test_noise_remembers_as_it_says(step: float) -> None:
    # Oracle: unit variance and (1 + t / m) exp(-t / m); 4000 frames of 200 channels.
    walk = wandering(np.random.default_rng(2), 4000, step, 200)
    assert walk.var() == pytest.approx(1.0, rel=0.03)
    for lag in (1, 3, 8):
        x = lag * step / MEMORY
        expected = (1.0 + x) * np.exp(-x)
        assert (walk[lag:] * walk[:-lag]).mean() == pytest.approx(expected, abs=0.03)
    noise = landmark_noise(np.random.default_rng(3), 400, 10.0)
    assert np.square(noise.mean(axis=0)).mean() == pytest.approx(TRACKER_HABIT, abs=0.05)


def test_fists_and_edges_are_harder() -> None:
    open_, fist, side = (
        np.sqrt(np.square(_errors(300, gesture, turn).turn).mean())
        for gesture, turn in (("open", 180.0), ("fist", 180.0), ("open", 265.0))
    )
    assert fist > 1.3 * open_
    assert side > 1.2 * open_
    assert growth(np.ones(1), np.zeros(1)) > growth(np.zeros(1), np.zeros(1))
    bent, straight = _held(1, "fist"), _held(1, "open", 265.0)
    assert curl(bent[0])[0] > 0.7 > 0.3 > curl(straight[0])[0]
    assert edge_on(posed_skeleton(_hand(), *straight).landmarks)[0] > 0.7


def test_joints_make_up_for_each_other() -> None:
    # Oracle: the same errors, each joint's from another frame. A fit keeps the hand on its image.
    pose, transl = _held(300, "relaxed")
    errors = _errors(300, "relaxed")
    turn = errors.turn
    mixed = np.stack([np.roll(turn[:, joint], 7 * joint, axis=0) for joint in range(16)], axis=1)

    def seen(turn: np.ndarray) -> np.ndarray:
        moved = posed_skeleton(_hand(), turned(pose, turn), transl + errors.shift).landmarks
        return moved[..., :2] / moved[..., 2:]

    still = posed_skeleton(_hand(), pose, transl).landmarks
    truth = still[..., :2] / still[..., 2:]
    away = [np.linalg.norm(seen(item) - truth, axis=2).mean() for item in (turn, mixed)]
    assert away[0] < 0.8 * away[1]


@pytest.fixture
def estimated(make_scene: SceneMaker) -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return a function: pose errors, shape errors and validity of the small scene's hand."""

    def run(estimator: Estimator | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        scene = replace(with_effects(make_scene(), []), estimator=estimator)
        plans = [plan_frame(scene, frame, FRAMES, 48) for frame in range(FRAMES)]
        truth = true_hands(scene, plans)
        given = estimate_hands(scene, truth, plans)["right"]
        return given.pose - truth["right"].pose, given.betas - truth["right"].betas, given.valid

    return run


def test_a_scene_that_names_no_estimator_is_what_it_was(
    make_scene: SceneMaker, estimated: Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> None:
    assert "estimator" not in make_scene().to_json()
    before, shape, _ = estimated(None)
    nothing, same, valid = estimated(Estimator("tracker", scale=0.0, failures=0.0))
    np.testing.assert_allclose(nothing, before, atol=1e-9)
    np.testing.assert_allclose(same, shape, atol=1e-12)
    assert valid.all()


def test_scenes_scale_the_errors_and_flag_the_failures(
    make_scene: SceneMaker, estimated: Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> None:
    lines = '[estimator]\nkind = "tracker"\nscale = 0.5\n\n[track]'
    scene = make_scene(("[track]", lines))
    assert scene.estimator == Estimator("tracker", scale=0.5)
    assert scene.digest != make_scene().digest
    plain = np.sqrt(np.square(estimated(None)[0]).mean())
    full, half = (
        np.sqrt(np.square(estimated(Estimator("tracker", scale=scale, failures=0.0))[0]).mean())
        for scale in (1.0, 0.5)
    )
    assert half == pytest.approx(0.5 * full, rel=0.15)
    assert full > 10.0 * plain
    often, _, valid = estimated(Estimator("tracker", failures=0.3))
    assert 0.1 < 1.0 - valid.mean() < 0.5
    assert np.abs(often[~valid]).mean() > 1.5 * np.abs(often[valid]).mean()
