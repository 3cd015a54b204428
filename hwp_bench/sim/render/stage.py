"""One instant: surfaces before the camera, and what the camera sees of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from hwp_bench.sim.effects import Placement
from hwp_bench.sim.geometry.surface import (
    Hits,
    RenderCost,
    Surface,
    Tracer,
    join,
    rigid,
    transformed,
    unit,
)
from hwp_bench.sim.light.lights import Lights, focus_point
from hwp_bench.sim.light.shading import gather, lamp_light, lit, openness, room_light, shade
from hwp_bench.sim.props.behind import backdrop_colors, draw_behind
from hwp_bench.sim.props.objects import build_object
from hwp_bench.sim.scene.scene import (
    HandMoment,
    Scene,
    hand_parameters,
    heading_matrix,
    pixel_rays,
    scene_hands,
)
from hwp_bench.sim.subject.arms import (
    arm_atlas,
    arm_openness,
    forearm,
    ring_mounts,
    seamless,
    sleeve,
    sleeve_material,
    wrist_loop,
    wrist_mounts,
    wrist_rim,
)
from hwp_bench.sim.subject.hand import FINE, of_side, skin_atlas, subject_hand
from hwp_bench.sim.subject.subject import Subject
from hwp_bench.sim.subject.wear import covered

# Place of the right elbow, m from the point looked at.
_ELBOW = np.array([0.10, 0.42, 0.02])
#: Who owns a part of the image: a hand, or nothing that counts as one.
OWNERS = {"right": 1, "left": 2, "": 3}


def _hand_surface(
    subject: Subject, side: str, subdivisions: int, pose: np.ndarray, transl: np.ndarray
) -> Surface:
    """A posed hand: `pose` (16, 3) rad, `transl` (3,) m."""
    hand = subject_hand(subject, side, subdivisions)
    vertices, normals = hand.pose(pose, transl)
    skin = hand.own_skin
    if skin is None:
        skin = skin_atlas(of_side(subject, side), side)
    surface = Surface(
        vertices=vertices,
        normals=normals,
        faces=hand.faces,
        corner_uv=hand.corner_uv,
        material=np.zeros(len(hand.faces), dtype=np.int64),
        materials=(skin,),
        hand=np.ones(len(hand.faces), dtype=bool),
    )
    if hand.own_skin is not None or not of_side(subject, side).looks.gloves:
        return surface
    # Light does not wrap around the terminator inside cloth.
    cloth = replace(skin, wrap=(0.0, 0.0, 0.0), specular=0.02)
    under = _gloved_faces(subject, side, subdivisions)
    return replace(surface, material=under, materials=(skin, cloth))


@lru_cache(maxsize=8)
def _gloved_faces(subject: Subject, side: str, subdivisions: int) -> np.ndarray:
    """(F,) 1 where most of a face is under a glove."""
    hand = subject_hand(subject, side, subdivisions)
    anatomy = hand.anatomy(hand.rest, hand.rest_normals, hand.lift @ hand.template.weights)
    glove = of_side(subject, side).looks.gloves[0]
    return (covered(anatomy, glove)[hand.faces].mean(axis=1) > 0.5).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Body:
    """Hands, sleeves and what is worn, at one instant."""

    #: All of them as one surface.
    surface: Surface
    #: The same, ready for rays.
    tracer: Tracer


class RenderStage:
    """Builds what a scene shows."""

    def __init__(self, scene: Scene, cost: RenderCost) -> None:
        self.scene = scene
        self.cost = cost

    def parameters(self, hands: dict[str, HandMoment]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Pose (16, 3) rad and transl (3,) m of every hand."""
        subjects = scene_hands(self.scene)
        return {
            side: hand_parameters(moment, side, subjects[side].joints)
            for side, moment in hands.items()
        }

    def surface(
        self,
        hands: dict[str, HandMoment],
        subdivisions: int = FINE,
        parameters: dict[str, tuple[np.ndarray, np.ndarray]] | None = None,
    ) -> Surface:
        """Hands, sleeves and what is worn, posed."""
        return join([part for _, part in self._parts(hands, subdivisions, parameters)])

    def owners(self, hands: dict[str, HandMoment]) -> np.ndarray:
        """Who owns each face of `surface(hands)`, as `OWNERS` numbers them: (F,)."""
        parts = self._parts(hands, FINE, None)
        return np.concatenate([np.full(len(part.faces), OWNERS[side]) for side, part in parts])

    def _parts(
        self,
        hands: dict[str, HandMoment],
        subdivisions: int,
        parameters: dict[str, tuple[np.ndarray, np.ndarray]] | None,
    ) -> list[tuple[str, Surface]]:
        """First the hands, then a sleeve or an arm for each, then what is worn.

        Each with the hand that it counts as, or an empty name.
        """
        subject = self.scene.subject
        parameters = parameters or self.parameters(hands)
        skins, arms, worn = [], [], []
        for side, moment in hands.items():
            skin = _hand_surface(subject, side, subdivisions, *parameters[side])
            mirror = 1.0 if side == "right" else -1.0
            forward = heading_matrix(moment.heading, side) @ np.array([-mirror, 0.0, 0.0])
            elbow = focus_point() + _ELBOW * np.array([mirror, 1.0, 1.0])
            if subject.looks.arm == "bare":
                rim = wrist_loop(subject, side, subdivisions)
                paint = arm_atlas(of_side(subject, side))
                arm = forearm(skin.vertices[rim.loop], rim.around, forward, elbow, paint)
                skin, arm = seamless(skin, arm, rim.loop)
            else:
                cloth = sleeve_material(subject.sleeve, subject.seed)
                loop = wrist_rim(subject_hand(subject, side, subdivisions).template)
                arm = sleeve(skin.vertices[loop], forward, elbow, cloth)
            skins.append((side, skin))
            arms.append(("", arm))
            for item in ring_mounts(subject, side):
                worn.append((side, item.carried(skin.vertices)))
            for item in wrist_mounts(subject, side, subdivisions):
                carrier = arm if item.on_arm else skin
                worn.append(("", item.carried(carrier.vertices)))
        return skins + arms + worn

    def traced(self, surface: Surface) -> Body:
        """A surface made ready for rays."""
        return Body(surface, Tracer(surface.vertices, surface.faces, self.cost.rays))

    def seen_sky(self, body: Body) -> dict[str, np.ndarray]:
        """Share of the sky that the template's vertices see, by side: (T,) each."""
        seen, start = {}, 0
        for side, subject in scene_hands(self.scene).items():
            coarse = slice(start, start + len(subject.template.vertices))
            seen[side] = openness(
                body.tracer, body.surface.vertices[coarse], body.surface.normals[coarse]
            )
            start += subject.lift.shape[0]
        return seen

    def under_sky(
        self, surface: Surface, seen: dict[str, np.ndarray], subdivisions: int = FINE
    ) -> Surface:
        """The surface with the share of the sky that each of its vertices sees."""
        subject, subjects = self.scene.subject, scene_hands(self.scene, subdivisions)
        shares = {side: subjects[side].lift @ share for side, share in seen.items()}
        parts = list(shares.values())
        if subject.looks.arm == "bare":
            for side, share in shares.items():
                parts.append(arm_openness(share[wrist_loop(subject, side, subdivisions).loop]))
        others = np.ones(len(surface.vertices) - sum(len(part) for part in parts))
        sky = np.clip(np.concatenate([*parts, others]), 0.0, 1.0)
        return replace(surface, openness=sky)

    def things(self, placements: list[Placement], hands: dict[str, HandMoment]) -> Body | None:
        """The objects of an instant, ready for rays, or None."""
        if not placements:
            return None
        with self.cost.time("objects"):
            return self.traced(self.objects(placements, hands))

    def objects(self, placements: list[Placement], hands: dict[str, HandMoment]) -> Surface:
        """The objects of an instant, at least one, as one surface."""
        parts = []
        for placement in placements:
            frame = rigid(None, focus_point())
            if placement.anchor != "world":
                moment = hands[placement.anchor]
                still = heading_matrix(np.zeros(3), placement.anchor)
                turn = heading_matrix(moment.heading, placement.anchor) @ still.T
                frame = rigid(turn, focus_point() + moment.place)
            thing = build_object(placement.name, placement.variant)
            parts.append(transformed(thing, frame @ placement.transform))
        return join(parts)


def between(bodies: tuple[Surface, Surface, Surface], s: float | np.ndarray) -> Surface:
    """A surface between three instants of the same hands."""
    first, middle, last = bodies
    a, b, c = 2.0 * s * s - s, 1.0 - 4.0 * s * s, 2.0 * s * s + s
    return replace(
        middle,
        vertices=a * first.vertices + b * middle.vertices + c * last.vertices,
        normals=unit(a * first.normals + b * middle.normals + c * last.normals),
    )


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
