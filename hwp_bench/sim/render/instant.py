"""One instant as the camera sees it: rays, shading, and what lies in front of what."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hwp_bench.sim.geometry.rays import Hits, RenderCost, Tracer
from hwp_bench.sim.light.lights import Lights
from hwp_bench.sim.light.samples import gather
from hwp_bench.sim.light.shading import lamp_light, lit, room_light, shade
from hwp_bench.sim.props.backdrops import backdrop_colors
from hwp_bench.sim.props.behind import draw_behind
from hwp_bench.sim.render.stage import Body
from hwp_bench.sim.scene.motion import pixel_rays
from hwp_bench.sim.scene.scene import Scene

# Pixels around the projected hands that rays are cast for.
_MARGIN = 2


@dataclass(frozen=True, eq=False)
class LinearImage:
    """Linear light and coverage of one instant, per pixel."""

    #: (S, S, 3) linear.
    color: np.ndarray
    #: (S, S) share of the pixel that shows hand, 0-1.
    coverage: np.ndarray


@dataclass(frozen=True, eq=False)
class Lens:
    """Camera and sampling of one instant."""

    #: (3, 3) px.
    K: np.ndarray
    #: (4, 4) world to camera.
    view: np.ndarray
    #: Edge of the image in pixels.
    size: int
    #: Edge of the grid of rays inside a pixel.
    grid: int
    #: Place of the grid inside the pixel, in steps of the grid, -0.5 to 0.5.
    shift: tuple[float, float] = (0.0, 0.0)
    #: Which part of the lamp the rays aim at first.
    turn: int = 0
    #: Time of the capture, s: where what moves behind the hands is.
    seconds: float = 0.0
    #: Views when the first and when the last row is read, or None where all are read at once.
    #: The backdrop follows them; what is cast stands where its row sees it (`rolling`).
    rows: tuple[np.ndarray, np.ndarray] | None = None


def render_instant(
    scene: Scene, lens: Lens, body: Body, things: Body | None, lights: Lights, cost: RenderCost
) -> LinearImage:
    """Render one instant."""
    with cost.time("backdrop"):
        directions = _directions(lens)
        color = backdrop_colors(scene.background, scene.seed, directions)
    if scene.behind.passes:
        with cost.time("behind"):
            color = draw_behind(
                scene.behind,
                scene.subject.tone,
                scene.camera.field_of_view,
                directions,
                lens.seconds,
                color,
            )
    with cost.time("backdrop"):
        color = color * lights.on_backdrop() * lights.exposure
        coverage = np.zeros((lens.size, lens.size))
    layers = [("hands", body)] + ([("objects", things)] if things is not None else [])
    box = _box(lens, [layer.surface.vertices for _, layer in layers])
    if box is None:
        return LinearImage(color, coverage)
    top, bottom, left, right = box
    origin, directions = pixel_rays(lens.K, lens.view, box, lens.grid, lens.shift)
    rows, columns = directions.shape[:2]
    rays = directions.reshape(-1, 3)
    shown = _spread(color[top:bottom, left:right], lens.grid).reshape(-1, 3)
    depth = np.full(len(rays), np.inf)
    hand = np.zeros(len(rays))
    tracers: list[Tracer] = [layer.tracer for _, layer in layers]
    for name, layer in layers:
        with cost.time(name):
            hits = layer.tracer.first_hits(origin[None], rays, name)
            hits = _nearer(hits, depth)
            samples = gather(layer.surface, hits, rays)
        with cost.time("shadow"):
            row, column = samples.ray // columns, samples.ray % columns
            turn = (row % 2 * 2 + column % 2 + lens.turn) % 4
            reached = lit(samples, lights, tracers, turn)
        with cost.time(name):
            towards = shade(samples, lights, reached)
        if lights.lamps:
            with cost.time("lamps"):
                towards += lamp_light(samples, lights, tracers, turn)
        if lights.room is not None:
            with cost.time("room"):
                towards += room_light(samples, lights)
        with cost.time(name):
            shown[samples.ray] = towards
            depth[samples.ray] = samples.distance
            hand[samples.ray] = samples.hand
    color[top:bottom, left:right] = _pool(shown.reshape(rows, columns, 3), lens.grid)
    coverage[top:bottom, left:right] = _pool(hand.reshape(rows, columns), lens.grid)
    return LinearImage(color, coverage)


def _directions(lens: Lens) -> np.ndarray:
    """Viewing directions of all pixels: (S, S, 3), world."""
    whole = (0, lens.size, 0, lens.size)
    _, directions = pixel_rays(lens.K, lens.view, whole, 1)
    if lens.rows is not None:
        _, first = pixel_rays(lens.K, lens.rows[0], whole, 1)
        _, last = pixel_rays(lens.K, lens.rows[1], whole, 1)
        directions = first + (last - first) * np.linspace(0.0, 1.0, lens.size)[:, None, None]
    return directions


def _box(lens: Lens, clouds: list[np.ndarray]) -> tuple[int, int, int, int] | None:
    """Rows and columns that the points project into, or None where there are none."""
    points = np.concatenate(clouds) @ lens.view[:3, :3].T + lens.view[:3, 3]
    if points[:, 2].min() <= 0.01:
        return 0, lens.size, 0, lens.size
    pixels = (points / points[:, 2:]) @ lens.K.T
    # Column by column: NumPy takes several times as long over the rows of a narrow array.
    across, down = pixels[:, 0], pixels[:, 1]
    left, top = (int(np.floor(places.min())) - _MARGIN for places in (across, down))
    right, bottom = (int(np.ceil(places.max())) + _MARGIN for places in (across, down))
    top, bottom, left, right = (min(max(v, 0), lens.size) for v in (top, bottom, left, right))
    return (top, bottom, left, right) if top < bottom and left < right else None


def _nearer(hits: Hits, depth: np.ndarray) -> Hits:
    """The hits that lie in front of what is there already."""
    front = hits.distance < depth[hits.ray]
    if front.all():
        return hits
    return replace(
        hits,
        ray=hits.ray[front],
        face=hits.face[front],
        weights=hits.weights[front],
        distance=hits.distance[front],
    )


def _spread(values: np.ndarray, grid: int) -> np.ndarray:
    """A copy of the pixels with each as often as it has rays."""
    if grid == 1:
        return values.copy()
    return np.repeat(np.repeat(values, grid, 0), grid, 1)


def _pool(values: np.ndarray, grid: int) -> np.ndarray:
    """Mean over the grid of rays inside each pixel."""
    if grid == 1:
        return values
    rows, columns = values.shape[0] // grid, values.shape[1] // grid
    return values.reshape(rows, grid, columns, grid, *values.shape[2:]).mean(axis=(1, 3))
