"""Rendering one frame: the recipe's passes in linear light, clean views, and layers as OpenEXR."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hwp_bench.base.colors import eight_bit_srgb
from hwp_bench.base.errors import HwpError
from hwp_bench.sim.effects import FramePlan, hands_at, lights_at, objects_at, plan_frame
from hwp_bench.sim.geometry.rays import RenderCost, Tracer
from hwp_bench.sim.geometry.surface import join
from hwp_bench.sim.light.lights import steady_light
from hwp_bench.sim.props.behind import NOTHING
from hwp_bench.sim.render.exposure import Rows, Window, exposed, metered_gain
from hwp_bench.sim.render.instant import Lens, LinearImage, render_instant
from hwp_bench.sim.render.stage import Stage
from hwp_bench.sim.scene.motion import (
    HandMoment,
    intrinsics,
    pixel_rays,
    viewmat,
)
from hwp_bench.sim.scene.scene import Scene
from hwp_bench.sim.sensor import record, store

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
    recipe = plan_frame(scene, frame, frame_count, size)
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
    colors = tuple(image.color for image in images)
    if scene.sensor.auto is not None:
        with cost.time("auto"):
            gain = metered_gain(scene, scene.sensor.auto, recipe.seconds, cost)
            colors = tuple(color * gain for color in colors)
    with cost.time("sensor"):
        colors = record(scene.sensor, scene.seed, recipe.frame, colors)
        return [store(scene.sensor, eight_bit_srgb(color)) for color in colors]


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

    Takes `view` (4, 4) world to camera, `gain` (3,) what `steady_gain` returns. Returns (S, S, 3)
    uint8 sRGB and (S, S) share of hand, 0-1.
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


#: Names of the channels, in their order.
CHANNELS = ("R", "G", "B", "Z", "N.X", "N.Y", "N.Z", "id", "motion.X", "motion.Y")
_OBJECT = 4


def frame_layers(scene: Scene, result: SimulatedFrame, frame_count: int, size: int) -> np.ndarray:
    """Compute the layers of a frame: (S, S, 10) float32 in the order of `CHANNELS`."""
    recipe = result.plan
    stage = Stage(scene, RenderCost())
    seconds = recipe.seconds
    later = seconds + scene.duration / frame_count
    hands = hands_at(scene, seconds)
    view = viewmat(scene, seconds)
    lens = Lens(intrinsics(scene, size), view, size, 1, seconds=seconds)
    body = stage.traced(stage.surface(hands))
    things = stage.things(objects_at(scene, recipe, seconds), hands)
    image = render_instant(scene, lens, body, things, lights_at(scene, recipe), RenderCost())
    future_hands = hands_at(scene, later)
    now, then = body.surface, stage.surface(future_hands)
    owner = stage.owners(hands)
    if things is not None:
        later_things = stage.things(objects_at(scene, recipe, later), future_hands)
        assert later_things is not None
        owner = np.concatenate([owner, np.full(len(things.surface.faces), _OBJECT)])
        now, then = join([now, things.surface]), join([then, later_things.surface])
    layers = np.zeros((size * size, len(CHANNELS)), dtype=np.float32)
    layers[:, :3] = image.color.reshape(-1, 3)
    origin, directions = pixel_rays(lens.K, view, (0, size, 0, size), 1)
    rays = directions.reshape(-1, 3)
    hits = Tracer(now.vertices, now.faces, Counter()).first_hits(
        np.broadcast_to(origin, rays.shape), rays, "layers"
    )
    corners = now.faces[hits.face]

    def spread(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkc->nc", hits.weights, values[corners])

    layers[hits.ray, 3] = hits.distance
    layers[hits.ray, 4:7] = spread(now.normals) @ view[:3, :3].T
    layers[hits.ray, 7] = owner[hits.face]
    before = _pixels(spread(now.vertices), lens.K, view)
    after = _pixels(spread(then.vertices), lens.K, viewmat(scene, later))
    layers[hits.ray, 8:] = after - before
    return layers.reshape(size, size, -1)


def write_layers(
    path: Path, scene: Scene, result: SimulatedFrame, frame_count: int, size: int
) -> None:
    """Write the layers of a frame as OpenEXR (32-bit floats, zip)."""
    import OpenImageIO as oiio

    layers = frame_layers(scene, result, frame_count, size)
    specification = oiio.ImageSpec(size, size, layers.shape[2], "float")
    specification.channelnames = CHANNELS
    specification.attribute("compression", "zip")
    specification.attribute("oiio:ColorSpace", "lin_rec709")
    temporary = path.with_name(f".{path.name}")
    file = oiio.ImageOutput.create(os.fspath(path))
    written = (
        file is not None
        and file.open(os.fspath(temporary), specification)
        and file.write_image(np.ascontiguousarray(layers))
        and file.close()
    )
    if not written:
        reason = file.geterror() if file is not None else oiio.geterror()
        raise HwpError(f"cannot be written ({reason.strip()})", where=path)
    os.replace(temporary, path)


def _pixels(points: np.ndarray, K: np.ndarray, view: np.ndarray) -> np.ndarray:
    in_camera = points @ view[:3, :3].T + view[:3, 3]
    return ((in_camera / in_camera[:, 2:]) @ K.T)[:, :2]


def eight_bit_coverage(coverage: np.ndarray) -> np.ndarray:
    """Coverage 0-1 in 8 bits, rounded down: 255 means that the hand covers the pixel fully."""
    return np.floor(255.0 * coverage + 1e-3).astype(np.uint8)
