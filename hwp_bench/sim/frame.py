"""Rendering one frame: the recipe's passes, carried out in linear light."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hwp_bench.sim.camera import FOCUS_DISTANCE, intrinsics, viewmat
from hwp_bench.sim.effects.base import Shutter
from hwp_bench.sim.ledger import Ledger
from hwp_bench.sim.motion import HandMoment
from hwp_bench.sim.picture import Lens, Picture, take_picture
from hwp_bench.sim.plan import FramePlan, hands_at, lights_at, objects_at, plan
from hwp_bench.sim.scene import Scene
from hwp_bench.sim.sensor import develop, sensor_noise
from hwp_bench.sim.shade import steady_light
from hwp_bench.sim.stage import Stage, between
from hwp_bench.sim.subject import MOVING

#: Edge of the grid of rays inside a pixel.
SUPERSAMPLING = 2
# The golden ratio's powers spread the sub-frames' rays evenly inside the pixel.
_SPREAD = (0.7548776662466927, 0.5698402909980532)


@dataclass(frozen=True, eq=False)
class FrameResult:
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
    ledger: Ledger


def render_frame(scene: Scene, frame: int, frame_count: int, size: int) -> FrameResult:
    """Render one frame and its clean version.

    Args:
        scene: the scene.
        frame: 0 to frame_count - 1.
        frame_count: frames over which the capture is spread.
        size: edge of the picture in pixels.
    """
    recipe = plan(scene, frame, frame_count, size)
    return carry_out(scene, recipe, size)


def carry_out(scene: Scene, recipe: FramePlan, size: int) -> FrameResult:
    """Render a frame by its recipe."""
    ledger = Ledger()
    stage = Stage(scene, ledger)
    hands = hands_at(scene, recipe.seconds)
    lens = Lens(intrinsics(scene, size), viewmat(scene, recipe.seconds), size, SUPERSAMPLING)
    with ledger.time("hands"):
        body = stage.traced(stage.surface(hands))
    with ledger.time("sky"):
        sky = stage.seen_sky(body)
        body = replace(body, surface=stage.under_sky(body.surface, sky))
    clean = take_picture(scene, lens, body, None, steady_light(scene.light), ledger)
    disturbed = clean
    if recipe.shutter is not None:
        disturbed = _exposed(stage, recipe, recipe.shutter, sky, lens)
    elif recipe.perturbed:
        things = stage.things(objects_at(scene, recipe, recipe.seconds), hands)
        disturbed = take_picture(scene, lens, body, things, lights_at(scene, recipe), ledger)
    with ledger.time("sensor"):
        noise = sensor_noise(scene, recipe.frame, size) if "sensor" in recipe.passes else None
        clean_rgb = develop(clean.color, noise)
        rgb = clean_rgb if disturbed is clean else develop(disturbed.color, noise)
    return FrameResult(
        rgb=rgb,
        clean=clean_rgb,
        coverage=disturbed.coverage,
        clean_coverage=clean.coverage,
        plan=recipe,
        ledger=ledger,
    )


def _exposed(
    stage: Stage, recipe: FramePlan, shutter: Shutter, sky: dict[str, np.ndarray], lens: Lens
) -> Picture:
    """The mean of the sub-frames: the shutter's integral in linear light.

    Hands are posed at the opening, the middle and the closing of the shutter and move on
    parabolas between; each sub-frame casts one ray a pixel, at another place inside it.
    """
    scene, lights = stage.scene, lights_at(stage.scene, recipe)
    width = 2.0 * FOCUS_DISTANCE * np.tan(np.radians(scene.camera.field_of_view) / 2.0)

    def hands(s: float) -> dict[str, HandMoment]:
        seconds = recipe.seconds + s * shutter.seconds
        return {
            side: replace(
                hand,
                place=hand.place + s * width * np.array([*shutter.hand, 0.0]),
                heading=hand.heading + s * np.array([0.0, 0.0, shutter.twist]),
            )
            for side, hand in hands_at(scene, seconds).items()
        }

    with stage.ledger.time("shutter"):
        first, middle, last = (stage.surface(hands(s), MOVING) for s in (-0.5, 0.0, 0.5))
        middle = stage.under_sky(middle, sky, MOVING)
    color = np.zeros((lens.size, lens.size, 3))
    coverage = np.zeros((lens.size, lens.size))
    for step in range(recipe.subframes):
        s = (step + 0.5) / recipe.subframes - 0.5
        seconds = recipe.seconds + s * shutter.seconds
        view = viewmat(scene, seconds)
        view[:2, 3] += s * width * np.array(shutter.camera)
        place = ((step + 1) * np.array(_SPREAD)) % 1.0 - 0.5
        moved = replace(
            lens, view=view, grid=1, shift=(float(place[0]), float(place[1])), turn=step
        )
        with stage.ledger.time("hands"):
            body = stage.traced(between((first, middle, last), s))
        things = stage.things(objects_at(scene, recipe, seconds), hands(s))
        picture = take_picture(scene, moved, body, things, lights, stage.ledger)
        color += picture.color / recipe.subframes
        coverage += picture.coverage / recipe.subframes
    return Picture(color, coverage)
