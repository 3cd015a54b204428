"""Hard cases of shadows, for `hwp-bench dev stability` and for the tests.

Obstacles are plates of two triangles, of which a formula says what they shade: a ray in float64
meets the plane of the plate at one point, which lies on the plate or does not.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from hwp_bench.hands.sources import load_template
from hwp_bench.stability import CaseGroup, Measured
from wildghand.gaussians.rig import make_rig
from wildghand.light.hand_shadows import LIFT, HandShadows, Obstacles
from wildghand.light.light import (
    DARKEST,
    NO_LIGHT,
    SRGB,
    CastLight,
    LightSamples,
    find_light,
    fit_light,
)

#: Largest difference of a factor on colours from float64, and what float32 rounds a factor of 1 to.
TOLERANCE, ROUNDING = 1e-6, 2e-7
_BY_FORMULA = "free where a ray by formula misses the plate"

#: Every hard case of shadows and light.
cases = CaseGroup("shadows")


def _plate(height: float, side: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """(4, 3) and (2, 3): a square about the z axis."""
    half = 0.5 * side
    corners = [[-half, -half], [half, -half], [half, half], [-half, half]]
    vertices = np.column_stack([np.array(corners), np.full(4, height)]).astype(np.float32)
    return vertices, np.array([[0, 1, 2], [0, 2, 3]])


def _places(count: int = 400) -> np.ndarray:
    """(M, 3) float32 m, on the plane z = 0, none at the border of a plate's shadow."""
    return np.column_stack(
        [np.random.default_rng(0).uniform(-0.12, 0.12, (count, 2)), np.zeros(count)]
    ).astype(np.float32)


def _leaning(degrees: float, turn: float = 0.3) -> np.ndarray:
    """A unit vector, so many degrees from +z."""
    angle = math.radians(degrees)
    flat = math.sin(angle) * np.array([math.cos(turn), math.sin(turn)])
    return np.array([*flat, math.cos(angle)], np.float32)


@cases.case(
    "light {:g} degrees from straight above a plate",
    _BY_FORMULA,
    0.0,
    30.0,
    60.0,
    88.0,
    120.0,
    180.0,
)
def _run_direction(degrees: float) -> Measured:
    places, direction, height = _places(), _leaning(degrees), 0.03
    normals = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (len(places), 1))
    free = Obstacles([_plate(height)]).free(places, normals, direction[None])[:, 0]
    cosine = float(direction[2])
    if cosine <= 0.02:  # the places face away: nothing is asked of the ray
        return Measured(bool((free == 1.0).all()), f"{int((free == 0).sum())} places shaded")
    met = places[:, :2] + direction[:2] * ((height - LIFT) / cosine)
    away = np.abs(met).max(axis=1) - 0.05
    sure = np.abs(away) > 1e-6
    wrong = int(((away > 0.0) != (free == 1.0))[sure].sum())
    return Measured(wrong == 0, f"{wrong} wrong, {int((free == 0).sum())} places shaded")


@cases.case("places that face away from the light", "free: they have no light to lose")
def _run_facing_away() -> Measured:
    places = _places()
    down = np.tile(np.array([0.0, 0.0, -1.0], np.float32), (len(places), 1))
    free = Obstacles([_plate(0.03)]).free(places, down, _leaning(0.0)[None])
    return Measured(bool((free == 1.0).all()), f"{int((free == 0).sum())} places shaded")


@cases.case("normals of length {:g}", "free, finite", 0.0)
@cases.case("normals of length {:g}", "free, finite", math.nan)
def _run_no_normal(length: float) -> Measured:
    places = _places()
    normals = np.full((len(places), 3), length, np.float32)
    light = CastLight(_leaning(0.0)[None], np.ones(1, np.float32), 0.5)
    free = Obstacles([_plate(0.03)]).free(places, normals, light.directions)
    dark = light.darkening(np.nan_to_num(normals), free, DARKEST)
    off = float(np.abs(dark - 1.0).max())
    return Measured(bool((free == 1.0).all()) and off <= TOLERANCE, f"off by {off:.0e}")


@cases.case("an obstacle {:g} m behind the places", "free", 0.03)
@cases.case("an obstacle {:g} m off the light's way", "free", 10.0)
def _run_out_of_the_way(distance: float) -> Measured:
    vertices, faces = _plate(-0.03 if distance < 1.0 else 0.03)
    if distance > 1.0:
        vertices = vertices + np.array([distance, 0.0, 0.0], np.float32)
    places = _places()
    up = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (len(places), 1))
    free = Obstacles([(vertices, faces)]).free(places, up, _leaning(20.0)[None])
    return Measured(bool((free == 1.0).all()), f"{int((free == 0).sum())} places shaded")


@cases.case("an obstacle of {} triangles without area", "free, finite", 1, 100)
def _run_flat_triangles(count: int) -> Measured:
    vertices = np.zeros((3, 3), np.float32)
    faces = np.tile([[0, 1, 2]], (count, 1))
    places = _places()
    up = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (len(places), 1))
    free = Obstacles([(vertices, faces)]).free(places, up, _leaning(10.0)[None])
    return Measured(bool((free == 1.0).all()), f"{int((free == 0).sum())} places shaded")


@cases.case(
    "ambient light of {:g} and a lamp of {:g}, half of it hidden",
    f"the factor to {TOLERANCE:g} of the formula",
    *((0.0, 1.0), (0.0, 1e-12), (1.0, 0.0), (0.0, 0.0), (1e6, 1e6), (0.25, 1.0)),
)
def _run_strengths(ambient: float, lamp: float) -> Measured:
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]], np.float32)
    directions = np.stack([_leaning(0.0), _leaning(45.0)])
    strengths = np.array([lamp, lamp], np.float32)
    light = CastLight(directions, strengths, ambient)
    free = np.array([[0.0, 1.0]] * 3)
    found = light.darkening(normals, free, DARKEST)
    falling = np.maximum(normals.astype(float) @ directions.T.astype(float), 0.0) * strengths
    whole = ambient + falling.sum(axis=1)
    left = ambient + (falling * free).sum(axis=1)
    # A little light from everywhere keeps 0 / 0 away: without light nothing is lost.
    wanted = np.clip((left + NO_LIGHT) / (whole + NO_LIGHT), DARKEST, 1.0) ** SRGB
    off = float(np.abs(found - wanted).max())
    sound = bool(np.isfinite(found).all() and (found > 0.0).all() and (found <= 1.0).all())
    return Measured(sound and off <= TOLERANCE, f"off by {off:.0e}")


@cases.case(
    "a hand {}",
    f"factors in (0, 1 + {ROUNDING:g}], the same bits alone and in a batch",
    "open",
    "closed",
)
def _run_hand(name: str) -> Measured:
    shadows = _shadows([_leaning(0.0), _leaning(100.0)], [1.0, 0.5], 0.2)
    pose = torch.zeros(2, 16, 3)
    pose[:, 1:, 2] = 0.0 if name == "open" else 1.2
    pose[1, 0, 0] = 0.7
    betas, transl = torch.zeros(10), torch.zeros(2, 3)
    both = shadows.of({"right": (pose, betas, transl)})["right"]
    one = shadows.of({"right": (pose[:1], betas, transl[:1])})["right"]
    sound = bool(both.isfinite().all() and (both > 0.0).all() and (both <= 1.0 + ROUNDING).all())
    return Measured(sound and torch.equal(both[:1], one), f"darkest {float(both.min()):.3f}")


@cases.case("a hand under light without a direction", "every factor is 1")
def _run_no_direction() -> Measured:
    shadows = _shadows([_leaning(0.0)], [0.0], 1.0)
    given = torch.zeros(1, 16, 3), torch.zeros(10), torch.zeros(1, 3)
    dark = shadows.of({"right": given})["right"]
    off = float((dark - 1.0).abs().max())
    return Measured(off <= TOLERANCE, f"off by {off:.0e}")


@cases.case("the light of {}", "no light is found, or a finite one", "no place", "one place")
@cases.case("the light of {}", "no light is found, or a finite one", "black places", "weights of 0")
@cases.case("the light of {}", "no light is found, or a finite one", "one normal", "normals of 0")
def _run_samples(name: str) -> Measured:
    count = {"no place": 0, "one place": 1}.get(name, 600)
    random = np.random.default_rng(1)
    normals = random.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = {"one normal": np.tile([0.0, 0.0, 1.0], (count, 1)), "normals of 0": 0 * normals}.get(
        name, normals
    )
    samples = LightSamples(
        places=np.arange(count) % 40,
        normals=normals,
        light=np.zeros(count) if name == "black places" else 0.2 + random.uniform(size=count),
        weights=np.zeros(count) if name == "weights of 0" else np.ones(count),
    )
    made = [find_light(samples), fit_light(samples)]
    numbers = [np.asarray(value) for one in made if one is not None for value in vars(one).values()]
    finite = all(np.isfinite(value).all() for value in numbers)
    return Measured(bool(finite), f"{sum(one is not None for one in made)} lights found")


def _shadows(directions: list[np.ndarray], strengths: list[float], ambient: float) -> HandShadows:
    light = CastLight(np.stack(directions), np.array(strengths, np.float32), ambient)
    return HandShadows({"right": make_rig(load_template(), 200)}, light)
