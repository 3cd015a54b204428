"""Exposure and white balance that a camera sets by itself, from coarse looks at the scene.

The camera meters the scene as it is without perturbations, so that a frame and its clean version
get the same gain, and removing an effect changes no other frame. It looks a few times a second;
each look depends on its own time only, so that any process can meter any frame by itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from hwp_bench.base.colors import LUMINANCE
from hwp_bench.sim.camera.sensor import AutoControl
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.geometry.rays import RenderCost
from hwp_bench.sim.light.lights import steady_light
from hwp_bench.sim.render.instant import Lens, render_instant
from hwp_bench.sim.render.stage import Stage
from hwp_bench.sim.scene.motion import intrinsics, track_moment, viewmat
from hwp_bench.sim.scene.scene import Scene
from hwp_bench.sim.subject.hand import MOVING

#: Edge of the image that is metered, px.
EDGE = 24
#: Looks in the time of one lag.
LOOKS_PER_LAG = 2
#: Lags that the camera remembers.
MEMORY = 3
#: Most that the exposure, and that red and blue against green, are moved, stops.
REACH = (3.0, 1.0)
#: Step of the white balance, stops.
BALANCE_STEP = 1.0 / 32.0
# Rates of the wandering, Hz, and how far red and blue wander against the exposure.
_RATES = (0.05, 0.4)
_BALANCE_WANDER = 0.5
# Darkest mean of an image that is metered.
_DARKEST = 1e-4


def metered_gain(scene: Scene, auto: AutoControl, seconds: float, cost: RenderCost) -> np.ndarray:
    """Factors on red, green and blue at a time: (3,).

    What the looks ask for is averaged in stops with weights that fall by e in one lag.
    """
    tick = auto.lag / LOOKS_PER_LAG
    last = int(np.floor(seconds / tick))
    through = seconds / tick - last
    before, now = (_remembered(scene, auto, look, tick, cost) for look in (last - 1, last))
    stops = (1.0 - through) * before + through * now
    stops += auto.wander * _wandering(scene, seconds) * [1.0, _BALANCE_WANDER, _BALANCE_WANDER]
    exposure, red, blue = stops
    red, blue = (BALANCE_STEP * np.round(value / BALANCE_STEP) for value in (red, blue))
    return np.exp2(np.array([exposure + red, exposure, exposure + blue]))


def _remembered(
    scene: Scene, auto: AutoControl, look: int, tick: float, cost: RenderCost
) -> np.ndarray:
    """Stops of exposure, red and blue at a look: the mean over what is remembered."""
    ages = np.arange(MEMORY * LOOKS_PER_LAG)
    weights = np.exp(-ages / LOOKS_PER_LAG)
    digest = scene.digest
    wanted = [
        _wanted(_seen(_Look(digest, max(look - int(age), 0), scene, tick, cost)), auto)
        for age in ages
    ]
    mean: np.ndarray = weights @ np.array(wanted) / weights.sum()
    return mean


def _wanted(mean: np.ndarray, auto: AutoControl) -> np.ndarray:
    """Stops of exposure, red and blue that an image with this mean (3,) asks for."""
    mean = np.maximum(mean, _DARKEST)
    exposure = np.log2(auto.level / float(mean @ LUMINANCE))
    # Grey world: the mean of an image is taken for grey.
    red, blue = np.log2(mean[1] / mean[0]), np.log2(mean[1] / mean[2])
    most, least = REACH
    return np.array(
        [
            auto.exposure * np.clip(exposure, -most, most),
            auto.white_balance * np.clip(red, -least, least),
            auto.white_balance * np.clip(blue, -least, least),
        ]
    )


@dataclass(frozen=True)
class _Look:
    """One look at a scene; its digest and number name it."""

    digest: str
    number: int
    scene: Scene = field(compare=False)
    tick: float = field(compare=False)
    cost: RenderCost = field(compare=False)


@lru_cache(maxsize=256)
def _seen(look: _Look) -> np.ndarray:
    """Mean linear colour of the clean scene: (3,)."""
    scene, seconds = look.scene, look.number * look.tick
    # Its own time is that of the pass `auto`; rays are counted as everywhere.
    cost = RenderCost(rays=look.cost.rays)
    stage = Stage(scene, cost)
    hands = {side: track_moment(scene, side, seconds) for side in scene.sides}
    body = stage.traced(stage.surface(hands, MOVING))
    lens = Lens(intrinsics(scene, EDGE), viewmat(scene, seconds), EDGE, 1, seconds=seconds)
    image = render_instant(scene, lens, body, None, steady_light(scene.light), cost)
    mean: np.ndarray = image.color.mean(axis=(0, 1))
    return mean


def _wandering(scene: Scene, seconds: float) -> np.ndarray:
    """Three slow waves of unit variance: (3,)."""
    rng = generator(scene.seed, "auto")
    rates, phases = rng.uniform(*_RATES, (3, 4)), rng.uniform(0.0, 2.0 * np.pi, (3, 4))
    waves: np.ndarray = np.sin(2.0 * np.pi * rates * seconds + phases).sum(axis=1) / np.sqrt(2.0)
    return waves
