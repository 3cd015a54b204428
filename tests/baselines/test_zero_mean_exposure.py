"""Exposures of zero mean and their controller. Oracles: homographies through four points in
float64, sums, a camera whose automatic exposure follows the size of the hand."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from fitted_parts import batch_of, fit_parts, material_of
from painted import (
    FRAMES,
    QUICK,
    SilentReport,
    hand_parameters,
    painted_avatar,
    painted_info,
    write_drawn,
)

from hwp_bench.capture import Capture
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.methods.contract import Avatar, Budget, RunSettings, TrainingCapture
from hwp_bench.methods.request import open_request, write_request
from plain_fit.method import PlainMethod
from wildghand.plain.model import PlainAvatar
from zero_mean_exposure_fit.method import (
    NUMBERS,
    POINTS,
    REACH,
    ZeroMeanExposureMethod,
    ZeroMeanExposureRecipe,
    develop,
    predict,
    shrink,
    start_controller,
)

SETTINGS = {**QUICK, "steps": 200, "frame_rate": 0.1, "dssim_weight": 0.2}


def some_image() -> torch.Tensor:
    return torch.rand(2, 5, 4, 3, generator=torch.Generator().manual_seed(3))


def test_zeros_change_nothing_and_stops_double() -> None:
    """Tolerance: 1e-4, for the 1e-5 that keeps black pixels from a division by 0."""
    image, numbers = some_image(), torch.zeros(2, NUMBERS)
    torch.testing.assert_close(develop(image, numbers), image, atol=1e-4, rtol=0.0)
    numbers[1, 0] = -1.0
    expected = torch.stack((image[0], 0.5 * image[1]))
    torch.testing.assert_close(develop(image, numbers), expected, atol=1e-4, rtol=0.0)
    assert (develop(torch.zeros(1, 2, 2, 3), torch.ones(1, NUMBERS)) == 0.0).all()


def test_chromaticities_go_by_the_homography_through_four_points() -> None:
    """The oracle solves the eight equations of a homography in float64; tolerance 1e-3."""
    image = some_image()[:1] + 0.2
    numbers = torch.randn(1, NUMBERS, generator=torch.Generator().manual_seed(4))
    made = develop(image, numbers)[0].double().numpy()
    start = np.array(POINTS)
    goal = start + numbers[0, 1:].double().numpy().reshape(4, 2) * np.array(REACH)[:, None]
    equations, values = [], []
    for (x, y), (u, v) in zip(start, goal, strict=True):
        equations += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
        values += [u, v]
    matrix = np.append(np.linalg.solve(equations, values), 1.0).reshape(3, 3)
    pixels = image[0].double().numpy()
    total = pixels.sum(axis=-1, keepdims=True)
    shares = np.concatenate((pixels[..., :2] / total, np.ones_like(total)), axis=-1) @ matrix.T
    chroma = shares[..., :2] / shares[..., 2:]
    exposed = total * 2.0 ** float(numbers[0, 0])
    np.testing.assert_allclose(made.sum(axis=-1, keepdims=True), exposed, rtol=1e-5)
    np.testing.assert_allclose(made[..., :2] / exposed, chroma, atol=1e-3)


def test_a_controller_starts_with_zeros_and_sees_means_of_parts() -> None:
    image = torch.rand(2, 30, 45, 3, generator=torch.Generator().manual_seed(6))
    seen, controller = shrink(image), start_controller(0, torch.device("cpu"))
    torch.testing.assert_close(seen[1, 2, 3], image[1, 4:6, 9:12].mean(dim=(0, 1)))
    assert (predict(seen, controller) == 0.0).all()
    controller["controller.out_bias"][0] = 0.5
    assert (predict(seen, controller)[:, 0] == 0.5).all()


@pytest.fixture(scope="module")
def breathing(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """A hand that comes nearer and goes away four times."""
    hand = hand_parameters("right", 0)
    place = hand.transl.copy()
    place[:, 2] += 0.12 * np.sin(2.0 * np.pi * np.arange(FRAMES) / 9.0)
    hands = {"right": dataclasses.replace(hand, transl=place)}
    folder = tmp_path_factory.mktemp("breathing") / "breathing"
    return write_drawn(folder, painted_info("breathing"), hands, painted_avatar(("right",)))


def stops_of(capture: Capture) -> np.ndarray:
    """Automatic exposure: the larger the hand, the darker it gets; some -1.4 to 0.8 stops."""
    area = np.array([(capture.mask(frame) > 127).mean() for frame in range(FRAMES)])
    return 2.0 * (1.0 - area / area.mean())


#: Stops of red, green and blue for one of the exposure: a brighter frame is redder.
TINT = np.array([1.15, 1.0, 0.85])


def exposed(image: np.ndarray, stops: float) -> np.ndarray:
    """What that camera makes of an image, 0 to 255, not rounded."""
    return np.clip(image * 2.0 ** (stops * TINT), 0.0, 255.0)


@pytest.fixture
def seen(breathing: Capture, tmp_path: Path) -> TrainingCapture:
    """The part of it that a method is given, as that camera sees it."""
    split = contiguous_split(breathing.info.id, FRAMES)
    run = RunSettings(SETTINGS, 0, Budget())
    training = open_request(write_request(tmp_path / "request", breathing, split, run))
    read, stops = training.frame, stops_of(breathing)
    training.frame = lambda index: exposed(read(index), stops[index]).astype(np.uint8)  # type: ignore[method-assign]
    return training


def test_numbers_have_mean_zero_after_every_step(seen: TrainingCapture) -> None:
    recipe = ZeroMeanExposureRecipe(material_of(seen), ZeroMeanExposureMethod(SETTINGS).settings)
    batches = recipe.batches()
    for step in range(8):
        recipe.step(next(batches), step / 8)
        assert recipe.numbers.mean(dim=0).abs().max() < 1e-6
    assert recipe.numbers.abs().max() > 0.01


def test_gains_are_found_and_those_of_unseen_frames_are_predicted(
    seen: TrainingCapture, breathing: Capture
) -> None:
    """Stops of training frames are right to a fifth of their spread, on top of a common shift.

    In each test frame the predicted gain is nearer to the true one than 1 is.
    """
    recipe = ZeroMeanExposureRecipe(material_of(seen), ZeroMeanExposureMethod(SETTINGS).settings)
    fit_parts(recipe, 200)
    assert recipe.numbers.mean(dim=0).abs().max() < 1e-6
    stops = stops_of(breathing)
    known = stops[recipe.material.frames.indices]
    found = recipe.numbers[:, 0].detach().numpy()
    assert np.abs(found - (known - known.mean())).mean() < 0.2 * known.std()
    plain = PlainAvatar(recipe.model, 0)
    for frame in seen.targets.tolist():
        image = plain.render(seen.hand_poses(frame), seen.camera(frame))[None, ..., :3]
        with torch.no_grad():
            predicted = float(predict(shrink(torch.from_numpy(image)), recipe.controller)[0, 0])
        true = 2.0 ** (stops[frame] - known.mean())
        assert abs(2.0**predicted - true) < 0.7 * abs(1.0 - true), (frame, predicted, true)


def test_the_camera_s_exposure_is_told_from_the_hand(
    seen: TrainingCapture, breathing: Capture
) -> None:
    """The plain fit has some 11 dB in test frames as the camera exposes them; 8 dB more are asked.

    Without the controller, which has no part in training frames, it is 2 dB.
    """
    stops = stops_of(breathing)

    def score(fit: Avatar) -> float:
        errors = []
        for frame in seen.targets.tolist():
            rgba = fit.render(seen.hand_poses(frame), seen.camera(frame))
            truth = exposed(breathing.frame(frame), stops[frame]) / 255.0
            errors.append(np.square(rgba[..., :3] - truth)[breathing.mask(frame) == 255].mean())
        return -10.0 * math.log10(np.mean(errors))

    make: Callable[[float], ZeroMeanExposureMethod] = lambda share: ZeroMeanExposureMethod(  # noqa: E731
        {**SETTINGS, "controller_from": share}, 0
    )
    plain, ours, without = (
        score(method.fit(seen, Budget(), SilentReport()))
        for method in (PlainMethod({**QUICK, "steps": 200}, 0), make(0.3), make(1.0))
    )
    assert ours > plain + 8.0, (plain, ours)
    assert ours > without + 5.0, (without, ours)


def test_what_the_controller_has_to_learn_is_no_divergence(
    make_training: Callable[..., TrainingCapture],
) -> None:
    """Oracle: the loss before the controller begins."""
    settings = ZeroMeanExposureMethod(SETTINGS).settings
    recipe = ZeroMeanExposureRecipe(material_of(make_training()), settings)
    recipe.numbers[::2], recipe.numbers[1::2] = 0.5, -0.5
    losses = []
    for fraction in (0.0, 0.99):
        batch = batch_of(recipe.material, 0, fraction=fraction)
        with torch.no_grad():
            drawing = recipe.draw(batch)
            losses.append(float(recipe.loss(batch, drawing, recipe.weights(batch, drawing))))
    assert losses[1] == pytest.approx(losses[0], rel=1e-6)
