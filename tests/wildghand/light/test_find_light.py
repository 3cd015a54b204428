"""The light that casts shadows. Oracles: lamps that are known, a ball whose shadow is geometry."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wildghand.light import CastLight, LightSamples, find_light
from wildghand.light.light import ring_around, spread_directions

LAMPS = np.array([[0.55, -0.6, -0.58], [-0.7, -0.2, -0.69]])
LAMPS /= np.linalg.norm(LAMPS, axis=1, keepdims=True)
STRENGTHS, AMBIENT = np.array([1.1, 0.6]), 0.4
# A ball in front of the places, and its radius.
BALL, RADIUS = np.array([0.01, -0.03, -0.05]), 0.025


def free(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Whether a ray passes the ball: its nearest point to the centre lies outside."""
    to_ball = BALL - points
    along = to_ball @ directions.T
    apart = (to_ball**2).sum(axis=1)[:, None] - along**2
    return np.where((along > 0.0) & (apart < RADIUS**2), 0.0, 1.0)


def samples(
    count: int = 6000, seed: int = 0, lamps: np.ndarray = LAMPS, shadows: bool = True
) -> tuple[LightSamples, np.ndarray]:
    """Places of random albedo near a plane that turn towards -z and move, and their points."""
    random = np.random.default_rng(seed)
    normals = random.normal(size=(count, 3)) * [1.0, 1.0, 0.6] - [0.0, 0.0, 0.8]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = random.uniform(-0.06, 0.06, (count, 3)) * [1.0, 1.0, 0.1]
    places = random.integers(0, 150, count)
    albedo = random.uniform(0.1, 0.8, 150)
    arrives = free(points, lamps) if shadows else 1.0
    strengths = STRENGTHS[: len(lamps)]
    irradiance = AMBIENT + (np.maximum(normals @ lamps.T, 0.0) * arrives) @ strengths
    light = albedo[places] * irradiance * random.normal(1.0, 0.03, count)
    made = LightSamples(
        places, normals, light, np.ones(count), lambda directions: free(points, directions)
    )
    return made, points


def truth(normals: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Share of the linear light that the ball leaves."""
    falling = np.maximum(normals @ LAMPS.T, 0.0) * STRENGTHS
    arriving = (falling * free(points, LAMPS)).sum(axis=1)
    return (AMBIENT + arriving) / (AMBIENT + falling.sum(axis=1))


def lamps_of(light: CastLight) -> np.ndarray:
    """(L, 3) the middles of the cones, which come before the 48 directions of the sky."""
    return light.directions[:-48:7]


@pytest.fixture(scope="module")
def found() -> CastLight:
    light = find_light(samples()[0])
    assert light is not None
    return light


def test_lamps_are_found_where_they_are(found: CastLight) -> None:
    near = lamps_of(found) @ LAMPS.T
    assert len(near) >= 2
    # Candidates are 8 degrees apart, and are refined to a fraction of it.
    assert near.max(axis=0).min() > np.cos(np.radians(5.0))
    # The two strongest are these.
    strong = found.strengths[:-48].reshape(-1, 7).sum(axis=1)
    assert near[np.argsort(-strong)[:2]].max(axis=1).min() > np.cos(np.radians(5.0))


def test_shadows_are_as_dark_as_they_are(found: CastLight) -> None:
    seen, points = samples(seed=9)
    # Without softness, as the truth has none.
    hard = find_light(samples()[0], softness=0.0)
    assert hard is not None
    dark = hard.darkening(seen.normals, free(points, hard.directions), 0.0) ** 2.2
    off = dark - truth(seen.normals, points)
    # What is left: 3 % noise, and borders of the shadow by directions that are up to 5 degrees off.
    assert np.sqrt(np.mean(off**2)) < 0.06
    # The places that the ball shades are known as such.
    assert np.corrcoef(dark, truth(seen.normals, points))[0, 1] > 0.95


def test_every_further_lamp_must_explain_something() -> None:
    one, _ = samples(lamps=LAMPS[:1])
    light = find_light(one)
    assert light is not None
    strong = light.strengths[:-48].reshape(-1, 7).sum(axis=1)
    assert int((strong > 0.1 * strong.max()).sum()) == 1
    none = find_light(one, lamps=0)
    assert none is not None
    assert len(none.directions) == 48


def test_gross_errors_change_little(found: CastLight) -> None:
    seen, _ = samples()
    wrong = seen.light.copy()
    wrong[::12] *= 5.0
    light = find_light(dataclasses.replace(seen, light=wrong))
    assert light is not None
    assert (lamps_of(light) @ LAMPS.T).max(axis=0).min() > np.cos(np.radians(6.0))


@pytest.mark.parametrize("value", [0.0, 1e-12, 1e6])
def test_light_of_one_value_gives_finite_factors(value: float) -> None:
    seen, points = samples(1000)
    light = find_light(dataclasses.replace(seen, light=np.full(1000, value)))
    assert light is not None
    assert (light.strengths >= 0.0).all()
    dark = light.darkening(seen.normals, free(points, light.directions), 0.15)
    assert np.isfinite(dark).all()
    assert (dark >= 0.15 ** (1 / 2.2)).all()
    assert (dark <= 1.0).all()


def test_too_few_samples_are_no_light() -> None:
    assert find_light(samples(100)[0]) is None
    seen, _ = samples(1000)
    weightless = dataclasses.replace(seen, weights=np.zeros(1000))
    assert find_light(weightless) is None


def test_it_repeats_exactly(found: CastLight) -> None:
    again = find_light(samples()[0])
    assert again is not None
    np.testing.assert_array_equal(again.directions, found.directions)
    np.testing.assert_array_equal(again.strengths, found.strengths)
    assert again.ambient == found.ambient


@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3),
    st.floats(0.0, 1.5),
    st.integers(1, 9),
)
def test_a_ring_lies_around_its_direction(
    vector: tuple[float, float, float], angle: float, count: int
) -> None:
    direction = np.array(vector) / np.linalg.norm(vector)
    ring = ring_around(direction, angle, count)
    np.testing.assert_allclose(np.linalg.norm(ring, axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(ring @ direction, np.cos(angle), atol=1e-9)
    if count > 1:
        np.testing.assert_allclose(ring.mean(axis=0), np.cos(angle) * direction, atol=1e-9)


def test_spread_directions_are_even() -> None:
    directions = spread_directions(200)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    # Oracle: the second moment of the uniform sphere is a third of the identity.
    np.testing.assert_allclose(directions.T @ directions / 200, np.eye(3) / 3, atol=0.01)
