"""Rendering one frame: exposure, shutter and rolling rows, clean views, and layers as OpenEXR.

The camera meters the scene as it is without perturbations, so that a frame and its clean version
get the same gain, and removing an effect changes no other frame. It looks a few times a second;
each look depends on its own time only, so that any process can meter any frame by itself.

Rolling shutter: a point is seen in the row that is read when the point is there. So each vertex
is put where it stands, relative to the camera, when its own row is read; one image of that
surface then shows every row at its own time, whatever hands, objects and camera do.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from hwp_bench.base.colors import LUMINANCE, eight_bit_srgb
from hwp_bench.base.errors import HwpError
from hwp_bench.sim.effects import (
    FramePlan,
    Shutter,
    hands_at,
    lights_at,
    objects_at,
    plan_frame,
    shown_in,
    strengths_at,
)
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.geometry.surface import (
    RenderCost,
    Surface,
    Tracer,
    join,
    rigid,
    transformed,
)
from hwp_bench.sim.light.lights import FOCUS_DISTANCE, steady_light
from hwp_bench.sim.props.behind import NOTHING
from hwp_bench.sim.render.stage import Body, Lens, LinearImage, RenderStage, between, render_instant
from hwp_bench.sim.scene.scene import (
    HandMoment,
    Scene,
    intrinsics,
    pixel_rays,
    track_moment,
    viewmat,
)
from hwp_bench.sim.sensor import AutoControl, record, store
from hwp_bench.sim.subject.hand import FINE, MOVING

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
    stage = RenderStage(scene, cost)
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


# The golden ratio's powers spread the sub-frames' rays evenly inside the pixel.
_SPREAD = (0.7548776662466927, 0.5698402909980532)
# Rounds in which place and time of a vertex find each other. Each shrinks the error by the way
# that the vertex moves down the image during the readout, in heights of the image.
_ROUNDS = 4

#: A surface at three instants, in the camera's axes at each: opening, middle, closing.
Knots = tuple[Surface, Surface, Surface]


def exposed(
    stage: RenderStage, window: Window, sky: dict[str, np.ndarray], lens: Lens
) -> LinearImage:
    """The mean of the sub-frames: the shutter's integral in linear light.

    Hands are posed at the opening, the middle and the closing of the shutter and move on
    parabolas between; each sub-frame casts one ray a pixel, at another place inside it.
    """
    scene, recipe = window.scene, window.recipe
    lights = lights_at(scene, recipe)
    rows = Rows(stage, window, sky) if recipe.readout else None
    if rows is None:
        with stage.cost.time("shutter"):
            first, middle, last = (stage.surface(window.hands(s), MOVING) for s in (-0.5, 0.0, 0.5))
            middle = stage.under_sky(middle, sky, MOVING)
    color = np.zeros((lens.size, lens.size, 3))
    coverage = np.zeros((lens.size, lens.size))
    for step in range(recipe.subframes):
        s = (step + 0.5) / recipe.subframes - 0.5
        place = ((step + 1) * np.array(_SPREAD)) % 1.0 - 0.5
        moved = replace(
            lens,
            view=window.view(s),
            grid=1,
            shift=(float(place[0]), float(place[1])),
            turn=step,
            seconds=window.seconds(s),
        )
        if rows is not None:
            moved = rows.lens(s, moved)
            body, things = rows.body(s, moved), rows.things(s, moved)
        else:
            with stage.cost.time("hands"):
                body = stage.traced(between((first, middle, last), s))
            placements = objects_at(scene, recipe, window.seconds(s))
            things = stage.things(placements, window.hands(s)) if placements else None
        image = render_instant(scene, moved, body, things, lights, stage.cost)
        color += image.color / recipe.subframes
        coverage += image.coverage / recipe.subframes
    return LinearImage(color, coverage)


@dataclass(frozen=True, eq=False)
class Window:
    """Hands and camera around the middle of a frame.

    Times `s` count lengths of the window from the middle of the frame: -0.5 is the opening of
    the shutter, 0.5 its closing. Without a shutter the window is the sensor's readout.
    """

    #: The scene.
    scene: Scene
    #: The frame's recipe.
    recipe: FramePlan
    #: What shakes while the window is open, or None.
    shutter: Shutter | None = None

    @property
    def length(self) -> float:
        """Length of the window, s."""
        return self.recipe.readout if self.shutter is None else self.shutter.seconds

    def seconds(self, s: float) -> float:
        """Time of the capture."""
        return self.recipe.seconds + s * self.length

    def hands(self, s: float) -> dict[str, HandMoment]:
        """The hands."""
        hands = hands_at(self.scene, self.seconds(s))
        if self.shutter is None:
            return hands
        way = np.array([*self.shutter.hand, 0.0])
        twist = np.array([0.0, 0.0, self.shutter.twist])
        for side, hand in hands.items():
            place, heading = hand.place + s * self._width * way, hand.heading + s * twist
            hands[side] = HandMoment(hand.angles, place, heading)
        return hands

    def view(self, s: float) -> np.ndarray:
        """(4, 4) world to camera; shaking shifts it, and only turns move the backdrop."""
        view = viewmat(self.scene, self.seconds(s))
        if self.shutter is not None:
            view[:2, 3] += s * self._width * np.array(self.shutter.camera)
        return view

    @property
    def _width(self) -> float:
        """Width of the image at the point looked at, m."""
        return 2.0 * FOCUS_DISTANCE * np.tan(np.radians(self.scene.camera.field_of_view) / 2.0)


class Rows:
    """Hands, sleeves and objects for a sensor that reads its rows in turn."""

    def __init__(self, stage: RenderStage, window: Window, sky: dict[str, np.ndarray]) -> None:
        self._stage = stage
        self._window = window
        self._readout = window.recipe.readout / window.length
        self._reach = self._readout if window.shutter is None else self._readout + 1.0
        detail = FINE if window.shutter is None else MOVING

        def surface(s: float) -> Surface:
            return stage.under_sky(stage.surface(window.hands(s), detail), sky, detail)

        with stage.cost.time("rolling"):
            self._knots = knots(surface, window.view, self._reach)

    def lens(self, s: float, lens: Lens) -> Lens:
        """The lens with the views of the rows, the middle one read at `s`."""
        half = self._readout / 2.0
        return replace(lens, rows=(self._window.view(s - half), self._window.view(s + half)))

    def body(self, s: float, lens: Lens) -> Body:
        """Hands and sleeves, the middle row read at `s`."""
        with self._stage.cost.time("rolling"):
            surface = row_by_row(self._knots, self._reach, s, self._readout, lens)
            return self._stage.traced(surface)

    def things(self, s: float, lens: Lens) -> Body | None:
        """Objects, the middle row read at `s`, or None."""
        window, stage = self._window, self._stage
        if not objects_at(window.scene, window.recipe, window.seconds(s)):
            return None

        def surface(later: float) -> Surface:
            seconds = window.seconds(s + later)
            placements = objects_at(window.scene, window.recipe, seconds)
            return stage.objects(placements, window.hands(s + later))

        def view(later: float) -> np.ndarray:
            return window.view(s + later)

        with stage.cost.time("objects"):
            at = knots(surface, view, self._readout)
            return stage.traced(row_by_row(at, self._readout, 0.0, self._readout, lens))


def knots(
    surface_at: Callable[[float], Surface], view_at: Callable[[float], np.ndarray], reach: float
) -> Knots:
    """A surface at three instants, in the camera's axes."""
    first, middle, last = (
        transformed(surface_at(time), view_at(time)) for time in (-reach / 2.0, 0.0, reach / 2.0)
    )
    return first, middle, last


def row_by_row(at: Knots, reach: float, time: float, readout: float, lens: Lens) -> Surface:
    """A surface with every vertex where it stands when its row is read.

    It is in the world, to be seen through `lens` as if all rows were read at once.
    """
    moments = np.full((len(at[0].vertices), 1), time)
    for _ in range(_ROUNDS):
        places = between(at, moments / reach).vertices
        row = lens.K[1, 1] * places[:, 1] / places[:, 2] + lens.K[1, 2]
        moments[:, 0] = time + (np.clip(row / lens.size, 0.0, 1.0) - 0.5) * readout
    return transformed(between(at, moments / reach), np.linalg.inv(lens.view))


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
    return carry_out(shown_in(scene, frame, frame_count), recipe, size)


def carry_out(scene: Scene, recipe: FramePlan, size: int) -> SimulatedFrame:
    """Render a frame by its recipe."""
    cost = RenderCost()
    stage = RenderStage(scene, cost)
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
    colors = _exposed(scene, recipe, tuple(image.color for image in images), cost)
    with cost.time("sensor"):
        colors = record(scene.sensor, scene.seed, recipe.frame, colors)
        return [store(scene.sensor, eight_bit_srgb(color)) for color in colors]


def _exposed(
    scene: Scene, recipe: FramePlan, colors: tuple[np.ndarray, ...], cost: RenderCost
) -> tuple[np.ndarray, ...]:
    """Linear light with the frame's exposure and white balance, where the camera sets them."""
    if scene.sensor.auto is None:
        return colors
    with cost.time("auto"):
        gain = metered_gain(scene, scene.sensor.auto, recipe.seconds, cost)
        return tuple(color * gain for color in colors)


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
    """Render hands without objects, blur, noise and compression: (S, S, 3) uint8, and coverage.

    Lamps, windows and walls stay where they are in the world. The backdrop is the one that the
    scene's own camera sees, and nothing moves before it.
    """
    stage = RenderStage(scene, cost)
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
    """Compute the layers of a frame: (S, S, 10) float32 in the order of `CHANNELS`.

    They show its middle: all rows at once, without blur. The light has the frame's exposure and
    white balance, and nothing else that the sensor does.
    Motion is how far what a pixel shows is shifted in the next frame, px. What moves before the
    backdrop (`Behind`) has the motion of the backdrop, and an object of an episode that ends with
    this frame has the motion that it would have at the same strength.
    """
    recipe = result.plan
    next_scene = shown_in(scene, recipe.frame + 1, frame_count)
    scene = shown_in(scene, recipe.frame, frame_count)
    stage = RenderStage(scene, RenderCost())
    seconds = recipe.seconds
    later = seconds + scene.duration / frame_count
    hands = hands_at(scene, seconds)
    view, later_view = viewmat(scene, seconds), viewmat(scene, later)
    lens = Lens(intrinsics(scene, size), view, size, 1, seconds=seconds)
    body = stage.traced(stage.surface(hands))
    body = replace(body, surface=stage.under_sky(body.surface, stage.seen_sky(body)))
    things = stage.things(objects_at(scene, recipe, seconds), hands)
    image = render_instant(scene, lens, body, things, lights_at(scene, recipe), RenderCost())
    future_hands = hands_at(next_scene, later)
    now, then = body.surface, stage.surface(future_hands)
    owner = stage.owners(hands)
    if things is not None:
        strengths = strengths_at(next_scene, (recipe.frame + 1) / frame_count)
        later_things = stage.things(objects_at(scene, recipe, later, strengths), future_hands)
        assert later_things is not None
        owner = np.concatenate([owner, np.full(len(things.surface.faces), _OBJECT)])
        now, then = join([now, things.surface]), join([then, later_things.surface])
    layers = np.zeros((size * size, len(CHANNELS)), dtype=np.float32)
    (light,) = _exposed(scene, recipe, (image.color,), stage.cost)
    layers[:, :3] = light.reshape(-1, 3)
    origin, directions = pixel_rays(lens.K, view, (0, size, 0, size), 1)
    rays = directions.reshape(-1, 3)
    # Only turns of the camera move the backdrop.
    layers[:, 8:] = _pixels(rays, lens.K, _turn(later_view)) - _pixels(rays, lens.K, _turn(view))
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
    after = _pixels(spread(then.vertices), lens.K, later_view)
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


def _turn(view: np.ndarray) -> np.ndarray:
    """A view (4, 4) of what is infinitely far: its rotation alone."""
    return rigid(view[:3, :3], np.zeros(3))


def _pixels(points: np.ndarray, K: np.ndarray, view: np.ndarray) -> np.ndarray:
    in_camera = points @ view[:3, :3].T + view[:3, 3]
    return ((in_camera / in_camera[:, 2:]) @ K.T)[:, :2]


def eight_bit_coverage(coverage: np.ndarray) -> np.ndarray:
    """Coverage 0-1 in 8 bits, rounded down: 255 means that the hand covers the pixel fully."""
    return np.floor(255.0 * coverage + 1e-3).astype(np.uint8)
