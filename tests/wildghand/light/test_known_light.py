"""A light from one half of the sphere. Oracle: a light that is known, and geometry by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from wildghand.light import KnownLight, LightSamples, fit_light

LAMPS = np.array([[0.6, 0.0, 0.8], [-0.5, 0.7, 0.51]])
LAMPS /= np.linalg.norm(LAMPS, axis=1, keepdims=True)


def truth(normals: np.ndarray) -> np.ndarray:
    """Irradiance of an ambient light and two lamps in front."""
    return 0.4 + np.maximum(normals @ LAMPS.T, 0.0) @ np.array([0.7, 0.4])


def unit(seed: int, count: int) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def samples(count: int = 6000, seed: int = 0) -> LightSamples:
    """Places of random albedo that turn, seen from +z."""
    random = np.random.default_rng(seed)
    normals = unit(seed, 2 * count)
    normals = normals[normals[:, 2] > 0.0][:count]
    places = random.integers(0, 200, len(normals))
    albedo = random.uniform(0.2, 0.8, 200)
    light = albedo[places] * truth(normals)
    return LightSamples(places, normals, light, normals[:, 2].copy())


@pytest.fixture(scope="module")
def found() -> KnownLight:
    light = fit_light(samples(), ridge=1e-4)
    assert light is not None
    return light


def test_no_light_is_negative(found: KnownLight) -> None:
    assert float(found.strengths.min()) >= 0.0
    assert float(found.ambient) >= 0.0
    # A hand whose colours grow without any light that could make them so.
    seen = samples(2000)
    odd = LightSamples(seen.places, seen.normals, 0.1 + seen.normals[:, 2] ** 8, seen.weights)
    light = fit_light(odd)
    assert light is not None
    assert float(light.strengths.min()) >= 0.0
    assert float(light.ambient) >= 0.0


def test_the_cap_is_that_of_the_samples(found: KnownLight) -> None:
    np.testing.assert_allclose(found.axis, [0.0, 0.0, 1.0], atol=0.05)
    expected = np.quantile(samples().normals @ found.axis.double().numpy(), 0.25)
    assert float(found.cosine) == pytest.approx(expected, abs=1e-5)


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3))
def test_the_nearest_known_normal_lies_in_the_cap(vector: tuple[float, float, float]) -> None:
    light = KnownLight(
        directions=torch.eye(3),
        strengths=torch.ones(3),
        ambient=torch.tensor(0.2),
        axis=torch.tensor([0.6, 0.0, 0.8]),
        cosine=torch.tensor(0.3),
    )
    normal = torch.tensor(vector) / float(np.linalg.norm(vector))
    nearest = light.nearest_known(normal)
    along = float(normal @ light.axis)
    if along >= 0.3:
        assert torch.equal(nearest, normal)
        assert float(light.unknown(normal, torch.tensor(1.0))) == 0.0
    # Straight behind, every direction is as near, and rounding alone says which.
    if along > -0.9999:
        assert float(nearest.norm()) == pytest.approx(1.0, abs=1e-5)
        assert float(nearest @ light.axis) >= 0.3 - 1e-3
        # Oracle of "nearest": the angle to a cap is the angle to its axis less the cap's.
        angle = math.acos(max(-1.0, min(1.0, along))) - math.acos(0.3)
        apart = math.acos(max(-1.0, min(1.0, float(nearest @ normal))))
        assert apart == pytest.approx(max(angle, 0.0), abs=5e-3)
    assert bool(nearest.isfinite().all())
    assert 0.2 <= float(light.ratio(normal, nearest)) <= 3.0


def test_the_rim_of_a_hand_is_known() -> None:
    light = fit_light(samples())
    assert light is not None
    behind = torch.tensor([0.0, 0.0, -1.0]).expand(3, 3)
    facing = torch.tensor([-0.1, 0.1, 1.0])
    np.testing.assert_allclose(light.unknown(behind, facing), [0.0, 0.5, 1.0], atol=1e-6)


def test_too_few_samples_are_no_light() -> None:
    few = samples(100)
    assert fit_light(few) is None
    seen = samples(2000)
    weightless = LightSamples(seen.places, seen.normals, seen.light, np.zeros(len(seen.light)))
    assert fit_light(weightless) is None


def test_normals_from_everywhere_leave_nothing_unknown() -> None:
    normals = unit(4, 3000)
    normals = np.concatenate([normals, -normals])
    light = fit_light(LightSamples(np.arange(6000) % 50, normals, truth(normals), np.ones(6000)))
    assert light is not None
    assert not bool(light.unknown(torch.from_numpy(unit(5, 100)).float(), torch.ones(100)).any())


def test_it_repeats_exactly(found: KnownLight) -> None:
    again = fit_light(samples(), ridge=1e-4)
    assert again is not None
    for name, tensor in found.to_tensors().items():
        assert torch.equal(tensor, again.to_tensors()[name])
