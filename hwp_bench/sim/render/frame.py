"""Rendering one frame: the recipe's passes, carried out in linear light."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hwp_bench.base.colors import eight_bit_srgb
from hwp_bench.sim.effects.base import SENSOR, registered
from hwp_bench.sim.effects.plan import FramePlan, hands_at, lights_at, objects_at, plan
from hwp_bench.sim.geometry.raycast import RenderCost
from hwp_bench.sim.render.exposure import Rows, Window, exposed
from hwp_bench.sim.render.instant import Lens, LinearImage, render_instant
from hwp_bench.sim.render.metering import metered_gain
from hwp_bench.sim.render.stage import Stage
from hwp_bench.sim.scene.optics import intrinsics, steady_light, viewmat
from hwp_bench.sim.scene.schema import Scene

#: Edge of the grid of rays inside a pixel.
SUPERSAMPLING = 2


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """Everything that is known about a rendered frame."""

    #: (S, S, 3) uint8 sRGB, with its perturbations.
    rgb: np.ndarray
    #: (S, S, 3) uint8 sRGB, without them.
    clean: np.ndarray
    #: (S, S) share of visible hand, 0-1.
    coverage: np.ndarray
    #: (S, S) share of hand in the clean version, 0-1.
    clean_coverage: np.ndarray
    #: The recipe.
    plan: FramePlan
    #: What it cost.
    cost: RenderCost


def render_frame(scene: Scene, frame: int, frame_count: int, size: int) -> SimulatedFrame:
    """Render one frame and its clean version.

    Args:
        scene: the scene.
        frame: 0 to frame_count - 1.
        frame_count: frames over which the capture is spread.
        size: edge of the image in pixels.
    """
    recipe = plan(scene, frame, frame_count, size)
    return carry_out(scene, recipe, size)


def carry_out(scene: Scene, recipe: FramePlan, size: int) -> SimulatedFrame:
    """Render a frame by its recipe."""
    cost = RenderCost()
    stage = Stage(scene, cost)
    hands = hands_at(scene, recipe.seconds)
    seconds = recipe.seconds
    lens = Lens(
        intrinsics(scene, size), viewmat(scene, seconds), size, SUPERSAMPLING, seconds=seconds
    )
    with cost.time("hands"):
        body = stage.traced(stage.surface(hands))
    with cost.time("sky"):
        sky = stage.seen_sky(body)
        body = replace(body, surface=stage.under_sky(body.surface, sky))
    rows = None
    if recipe.readout:
        rows = Rows(stage, Window(scene, recipe), sky)
        body, lens = rows.body(0.0, lens), rows.lens(0.0, lens)
    clean = render_instant(scene, lens, body, None, steady_light(scene.light), cost)
    disturbed = clean
    if recipe.shutter is not None:
        disturbed = exposed(stage, Window(scene, recipe, recipe.shutter), sky, lens)
    elif recipe.perturbed:
        if rows is not None:
            things = rows.things(0.0, lens)
        else:
            things = stage.things(objects_at(scene, recipe, recipe.seconds), hands)
        disturbed = render_instant(scene, lens, body, things, lights_at(scene, recipe), cost)
    images = _developed(scene, recipe, (clean,) if disturbed is clean else (clean, disturbed), cost)
    return SimulatedFrame(
        rgb=images[-1],
        clean=images[0],
        coverage=disturbed.coverage,
        clean_coverage=clean.coverage,
        plan=recipe,
        cost=cost,
    )


def _developed(
    scene: Scene, recipe: FramePlan, images: tuple[LinearImage, ...], cost: RenderCost
) -> list[np.ndarray]:
    """Images of the same frame as the sensor stores them: (S, S, 3) uint8 sRGB each."""
    sensor = registered(SENSOR)
    colors = tuple(image.color for image in images)
    if scene.sensor.auto is not None:
        with cost.time("auto"):
            gain = metered_gain(scene, scene.sensor.auto, recipe.seconds, cost)
            colors = tuple(color * gain for color in colors)
    with cost.time("sensor"):
        colors = sensor.record(scene, recipe.frame, colors)
        return [sensor.store(scene, eight_bit_srgb(color)) for color in colors]
