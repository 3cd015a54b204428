"""Rendering one frame: the recipe's passes, carried out in linear light."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from hwp_bench.sim.backdrop import look
from hwp_bench.sim.camera import focus_point, intrinsics, pixel_rays, viewmat
from hwp_bench.sim.colors import linear_to_srgb
from hwp_bench.sim.effects.base import Placement
from hwp_bench.sim.motion import HandMoment, hand_parameters, heading_matrix
from hwp_bench.sim.plan import FramePlan, hands_at, lights_at, objects_at, plan
from hwp_bench.sim.raycast import LIFT, Tracer
from hwp_bench.sim.scene import Scene
from hwp_bench.sim.seeds import generator
from hwp_bench.sim.shade import Lights, Samples, gather, shade, steady_light
from hwp_bench.sim.sleeve import sleeve, sleeve_material, wrist_rim
from hwp_bench.sim.subject import SubjectHand, scene_hands, skin_atlas
from hwp_bench.sim.surface import Material, Surface, join, transformed

#: Edge of the grid of rays inside a pixel.
SUPERSAMPLING = 2
#: Rays per vertex that look for the sky.
SKY_RAYS = 24
#: How far the sky's rays reach, m: beyond it nothing darkens.
SKY_REACH = 0.08
# Half angle of the key light's disc as a slope; makes the rim of shadows soft.
_LIGHT_RADIUS = 0.06


@dataclass
class Ledger:
    """Measured cost of a frame: seconds by pass, rays by purpose."""

    #: Seconds by pass.
    seconds: Counter[str] = field(default_factory=Counter)
    #: Rays by purpose.
    rays: Counter[str] = field(default_factory=Counter)

    @contextmanager
    def time(self, name: str) -> Iterator[None]:
        """Charge what happens inside to one pass."""
        start = time.perf_counter()
        yield
        self.seconds[name] += time.perf_counter() - start


@dataclass(frozen=True, eq=False)
class Picture:
    """Linear light and coverage of one instant, per pixel."""

    #: (S, S, 3) linear.
    color: np.ndarray
    #: (S, S) share of the pixel that shows hand, 0-1.
    coverage: np.ndarray


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
    #: Per side: pose (16, 3) rad and transl (3,) m, the true ones.
    hands: dict[str, tuple[np.ndarray, np.ndarray]]
    #: (4, 4) world to camera.
    viewmat: np.ndarray
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
    ledger = Ledger()
    stage = _Stage(scene, size, ledger)
    hands = hands_at(scene, recipe.seconds)
    view = viewmat(scene, recipe.seconds)
    body = stage.body(hands)
    lights = steady_light(scene.light)
    clean = stage.picture(body, None, view, lights)
    disturbed = clean
    if recipe.perturbed:
        disturbed = _disturbed(stage, recipe, body, view)
    noise = _sensor_noise(scene, frame, size) if "sensor" in recipe.passes else None
    with ledger.time("sensor"):
        clean_rgb = _develop(clean.color, noise)
        rgb = clean_rgb if disturbed is clean else _develop(disturbed.color, noise)
    return FrameResult(
        rgb=rgb,
        clean=clean_rgb,
        coverage=disturbed.coverage,
        clean_coverage=clean.coverage,
        hands=stage.parameters(hands),
        viewmat=view,
        plan=recipe,
        ledger=ledger,
    )


def _disturbed(stage: _Stage, recipe: FramePlan, body: Surface, view: np.ndarray) -> Picture:
    scene = stage.scene
    lights = lights_at(scene, recipe)
    if recipe.shutter is None:
        things = stage.things(
            objects_at(scene, recipe, recipe.seconds), hands_at(scene, recipe.seconds)
        )
        return stage.picture(body, things, view, lights)
    shutter = recipe.shutter
    width = 2.0 * 0.5 * np.tan(np.radians(scene.camera.field_of_view) / 2.0)
    color, coverage = 0.0, 0.0
    for step in range(recipe.subframes):
        s = (step + 0.5) / recipe.subframes - 0.5
        seconds = recipe.seconds + s * shutter.seconds
        hands = {
            side: replace(
                hand,
                place=hand.place + s * width * np.array([*shutter.hand, 0.0]),
                heading=hand.heading + s * np.array([0.0, 0.0, shutter.twist]),
            )
            for side, hand in hands_at(scene, seconds).items()
        }
        shaken = viewmat(scene, seconds).copy()
        shaken[:2, 3] += s * width * np.array(shutter.camera)
        things = stage.things(objects_at(scene, recipe, seconds), hands)
        picture = stage.picture(stage.body(hands), things, shaken, lights)
        color = color + picture.color / recipe.subframes
        coverage = coverage + picture.coverage / recipe.subframes
    return Picture(color=np.asarray(color), coverage=np.asarray(coverage))


class _Stage:
    """What the passes of one frame share."""

    def __init__(self, scene: Scene, size: int, ledger: Ledger) -> None:
        self.scene = scene
        self.size = size
        self.ledger = ledger
        self.subjects = scene_hands(scene)
        self.K = intrinsics(scene, size)

    def parameters(self, hands: dict[str, HandMoment]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        focus = focus_point()
        return {
            side: hand_parameters(moment, side, self.subjects[side].joints, focus)
            for side, moment in hands.items()
        }

    def body(self, hands: dict[str, HandMoment]) -> Surface:
        """Hands and sleeves, posed, with the share of the sky that they see."""
        with self.ledger.time("hands"):
            parts, counts = [], []
            skin = _skin_material(self.scene)
            cloth = sleeve_material(self.scene.subject.sleeve, self.scene.subject.seed)
            for side, (pose, transl) in self.parameters(hands).items():
                subject = self.subjects[side]
                vertices, normals = subject.pose(pose, transl)
                parts.append(_hand_surface(subject, vertices, normals, skin))
                counts.append(len(vertices))
                rim = vertices[wrist_rim(subject.template.faces)]
                turn = heading_matrix(hands[side].heading, side)
                forward = turn @ np.array([-1.0 if side == "right" else 1.0, 0.0, 0.0])
                elbow = focus_point() + _elbow(side)
                parts.append(sleeve(rim, forward, elbow, cloth))
            whole = join(parts)
        with self.ledger.time("sky"):
            tracer = Tracer(whole.vertices, whole.faces, self.ledger.rays)
            openness = np.ones(len(whole.vertices))
            start = 0
            for side, part in zip(hands, parts[::2], strict=True):
                coarse = len(self.subjects[side].template.vertices)
                here = _openness(tracer, part.vertices[:coarse], part.normals[:coarse])
                openness[start : start + len(part.vertices)] = self.subjects[side].lift @ here
                start += len(part.vertices)
                start += len(parts[parts.index(part) + 1].vertices)
        return replace(whole, openness=openness)

    def things(
        self, placements: tuple[Placement, ...], hands: dict[str, HandMoment]
    ) -> Surface | None:
        """The objects of an instant, or None."""
        if not placements:
            return None
        from hwp_bench.sim.objects import build_object

        with self.ledger.time("objects"):
            parts = []
            for placement in placements:
                frame = np.eye(4)
                frame[:3, 3] = focus_point()
                if placement.anchor != "world":
                    moment = hands[placement.anchor]
                    still = heading_matrix(np.zeros(3), placement.anchor)
                    turn = heading_matrix(moment.heading, placement.anchor) @ still.T
                    frame[:3, :3] = turn
                    frame[:3, 3] += moment.place
                parts.append(
                    transformed(build_object(placement.request), frame @ placement.transform)
                )
            return join(parts)

    def picture(
        self, body: Surface, things: Surface | None, view: np.ndarray, lights: Lights
    ) -> Picture:
        """Render one instant."""
        size, grid = self.size, SUPERSAMPLING
        edge = size * grid
        origin, directions = pixel_rays(self.K, view, size, grid)
        rays = directions.reshape(-1, 3)
        origins = np.broadcast_to(origin, rays.shape)
        with self.ledger.time("backdrop"):
            color = self._backdrop(view, lights)
            color = np.repeat(np.repeat(color, grid, axis=0), grid, axis=1).reshape(-1, 3)
        depth = np.full(len(rays), np.inf)
        hand = np.zeros(len(rays))
        surfaces = [("hands", body)] + ([("objects", things)] if things is not None else [])
        tracers = []
        for name, surface in surfaces:
            with self.ledger.time(name):
                tracers.append(Tracer(surface.vertices, surface.faces, self.ledger.rays))
        for (name, surface), tracer in zip(surfaces, tracers, strict=True):
            with self.ledger.time(name):
                hits = tracer.first_hits(origins, rays, name)
                nearer = hits.distance < depth[hits.ray]
                hits = replace(
                    hits,
                    ray=hits.ray[nearer],
                    face=hits.face[nearer],
                    weights=hits.weights[nearer],
                    distance=hits.distance[nearer],
                )
                samples = gather(surface, hits, rays)
            with self.ledger.time("shadow"):
                lit = _lit(samples, lights, tracers, edge)
            with self.ledger.time(name):
                color[samples.ray] = shade(samples, lights, lit)
                depth[samples.ray] = samples.distance
                hand[samples.ray] = samples.hand
        return Picture(
            color=_pool(color.reshape(edge, edge, 3), grid),
            coverage=_pool(hand.reshape(edge, edge), grid),
        )

    def _backdrop(self, view: np.ndarray, lights: Lights) -> np.ndarray:
        _, directions = pixel_rays(self.K, view, self.size, 1)
        seen = look(self.scene.background, self.scene.seed, directions)
        return seen * (0.45 * lights.key + 0.5 * lights.sky) * lights.exposure


def _hand_surface(
    subject: SubjectHand, vertices: np.ndarray, normals: np.ndarray, skin: Material
) -> Surface:
    return Surface(
        vertices=vertices,
        normals=normals,
        faces=subject.faces,
        corner_uv=subject.corner_uv,
        material=np.zeros(len(subject.faces), dtype=np.int64),
        materials=(skin,),
        hand=np.ones(len(subject.faces), dtype=bool),
    )


def _skin_material(scene: Scene) -> Material:
    atlas = skin_atlas(scene.subject)
    return Material(
        albedo=atlas.albedo,
        roughness=atlas.roughness,
        specular=0.028,
        height=atlas.height,
        wrap=(0.28, 0.12, 0.07),
    )


def _elbow(side: str) -> np.ndarray:
    mirror = 1.0 if side == "right" else -1.0
    return np.array([0.10 * mirror, 0.42, 0.02])


def _openness(tracer: Tracer, vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Share of the upper half space, weighted by the cosine, that nothing near blocks: (V,)."""
    index = np.arange(SKY_RAYS) + 0.5
    height = np.sqrt(1.0 - index / SKY_RAYS)
    spin = np.pi * (3.0 - np.sqrt(5.0)) * index
    flat = np.sqrt(1.0 - height**2)
    local = np.stack([flat * np.cos(spin), flat * np.sin(spin), height], axis=1)
    helper = np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    tangent = np.cross(helper, normals)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    frames = np.stack([tangent, np.cross(normals, tangent), normals], axis=1)
    directions = np.einsum("rk,vkc->vrc", local, frames).reshape(-1, 3)
    origins = np.repeat(vertices + 2.0 * LIFT * normals, SKY_RAYS, axis=0)
    hits = tracer.first_hits(origins, directions, "sky")
    blocked = np.zeros(len(directions))
    blocked[hits.ray] = np.clip(1.0 - hits.distance / SKY_REACH, 0.0, 1.0) ** 0.5
    return 1.0 - blocked.reshape(-1, SKY_RAYS).mean(axis=1)


def _lit(samples: Samples, lights: Lights, tracers: list[Tracer], edge: int) -> np.ndarray:
    """Share of the key light that arrives at each sample: 0 or 1."""
    lit = np.ones(len(samples.ray))
    facing = np.flatnonzero(samples.flat @ lights.direction > 0.0)
    # The rays of one pixel aim at different points of the lamp, which softens the shadow.
    row, column = samples.ray[facing] // edge, samples.ray[facing] % edge
    helper = np.array([0.0, 0.0, 1.0]) if abs(lights.direction[2]) < 0.9 else np.array([1.0, 0, 0])
    first = np.cross(lights.direction, helper)
    first /= np.linalg.norm(first)
    second = np.cross(lights.direction, first)
    shift = np.array([[-0.4, -0.8], [0.8, -0.4], [-0.8, 0.4], [0.4, 0.8]])
    pick = shift[(row % 2) * 2 + column % 2] * _LIGHT_RADIUS
    directions = lights.direction + pick[:, :1] * first + pick[:, 1:] * second
    origins = samples.points[facing] + LIFT * samples.flat[facing]
    dark = np.zeros(len(facing), dtype=bool)
    for tracer in tracers:
        dark |= tracer.blocked(origins, directions, "shadow")
    lit[facing[dark]] = 0.0
    return lit


def _pool(values: np.ndarray, grid: int) -> np.ndarray:
    """Mean over the grid of rays inside each pixel."""
    edge = values.shape[0] // grid
    return values.reshape(edge, grid, edge, grid, *values.shape[2:]).mean(axis=(1, 3))


def _sensor_noise(scene: Scene, frame: int, size: int) -> np.ndarray:
    rng = generator(scene.seed, "sensor", frame)
    return scene.noise * rng.normal(size=(size, size, 3))


def _develop(color: np.ndarray, noise: np.ndarray | None) -> np.ndarray:
    """Linear light to 8-bit sRGB; noise grows with the square root of the light."""
    if noise is not None:
        color = color + noise * np.sqrt(np.clip(color, 0.02, 1.0))
    return np.round(linear_to_srgb(color) * 255.0).astype(np.uint8)
