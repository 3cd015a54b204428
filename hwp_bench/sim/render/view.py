"""One clean view of hands in any pose, from any camera, in the scene's steady light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hwp_bench.base.colors import eight_bit_srgb
from hwp_bench.sim.geometry.raycast import RenderCost
from hwp_bench.sim.render.frame import SUPERSAMPLING
from hwp_bench.sim.render.instant import Lens, render_instant
from hwp_bench.sim.render.metering import metered_gain
from hwp_bench.sim.render.stage import Stage
from hwp_bench.sim.scene.behind import NOTHING
from hwp_bench.sim.scene.motion import HandMoment
from hwp_bench.sim.scene.optics import intrinsics, steady_light
from hwp_bench.sim.scene.schema import Scene

# Times of the capture whose exposure is averaged.
_METERED = 8


def render_view(
    scene: Scene,
    hands: dict[str, HandMoment],
    view: np.ndarray,
    size: int,
    gain: np.ndarray,
    cost: RenderCost,
) -> tuple[np.ndarray, np.ndarray]:
    """Render hands without objects, blur, noise and compression.

    Lamps, windows and walls stay where they are in the world. The backdrop is the one that the
    scene's own camera sees, and nothing moves before it.

    Args:
        scene: the scene.
        hands: what the hands do, by side.
        view: (4, 4) world to camera.
        size: edge of the image, px.
        gain: (3,) what `steady_gain` returns.
        cost: is charged with time and rays.

    Returns:
        (S, S, 3) uint8 sRGB and (S, S) share of hand, 0-1.
    """
    stage = Stage(scene, cost)
    with cost.time("hands"):
        body = stage.traced(stage.surface(hands))
    with cost.time("sky"):
        body = replace(body, surface=stage.under_sky(body.surface, stage.seen_sky(body)))
    still = np.eye(4)
    lens = Lens(intrinsics(scene, size), view, size, SUPERSAMPLING, rows=(still, still))
    light = steady_light(scene.light)
    image = render_instant(replace(scene, behind=NOTHING), lens, body, None, light, cost)
    return eight_bit_srgb(image.color * gain), image.coverage


def steady_gain(scene: Scene, cost: RenderCost) -> np.ndarray:
    """One exposure and white balance for all views of a scene: (3,).

    For a camera that sets both by itself it is the geometric mean over the capture, else 1.
    """
    auto = scene.sensor.auto
    if auto is None:
        return np.ones(3)
    with cost.time("auto"):
        times = (np.arange(_METERED) + 0.5) / _METERED * scene.duration
        gains = [metered_gain(scene, auto, float(seconds), cost) for seconds in times]
    return np.asarray(np.exp(np.mean(np.log(gains), axis=0)))
