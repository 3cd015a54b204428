"""The free-view clip of a capture: unseen poses, cameras all around, truth for every pixel.

It lies in a folder of its own inside the capture, as a small capture, and is not a part of the
capture's digest. Objects, blur, noise and compression are absent, and hand parameters are true, so
that it measures the avatar alone.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.arrays import read_npz
from hwp_bench.base.console import progress
from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.base.files import atomic_write
from hwp_bench.base.folders import scratch_folder
from hwp_bench.base.numerics import kd_tree
from hwp_bench.capture import Cameras, CaptureInfo, CaptureWriter, open_capture
from hwp_bench.capture.schema import FREE_VIEW, MAX_ID
from hwp_bench.hands.poses import gestures, within_limits
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.geometry.surface import RenderCost, unit
from hwp_bench.sim.light.lights import FOCUS_DISTANCE
from hwp_bench.sim.render.frame import eight_bit_coverage, render_view, steady_gain
from hwp_bench.sim.scene.scene import (
    HandMoment,
    Scene,
    hand_parameters,
    heading_matrix,
    intrinsics,
    parameters_of,
    scene_hands,
    track_moment,
)
from hwp_bench.sim.subject.hand import template_vertices

#: Frames of a clip.
FRAMES = 24
#: Half the angle of the cone about the forearm from which no camera looks, degrees: from there
#: the sleeve hides the hand.
FOREARM_CONE = 45.0
#: Fewest gestures that a clip shows, where scenes use most of them.
_FEWEST = 4
# Standard deviation of joint angles and of the turn of the whole hand, degrees.
_ANGLES, _TURN = 5.0, 15.0
# Turn about the axis from one camera to the next, rad: no two azimuths meet.
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
#: Version of the clips; one of another version is made again.
VERSION = 1
#: What `source.kind` of a clip says.
KIND = "simulated free view"
#: Least distance between two hands, m.
GAP = 0.015
#: Largest distance of the hand from the middle of the image, in sizes of the image.
REACH = 0.47
#: Fewest pixels that the hand covers fully, of the image's; else the camera moves to the fingers.
LEAST_HAND = 0.005
# How often it moves at most, each time half of the way.
_MOVES = 4


def unseen_gestures(scene: Scene) -> tuple[str, ...]:
    """Names of the hand shapes that the clip shows, in the order of `gestures.toml`.

    They are those of which neither the track nor an effect has a key. Where too few are left,
    effects' own count too, and then all.
    """
    track = {key.gesture for keys in scene.track.keys.values() for key in keys}
    staged = {name for call in scene.effects for name in _named(call.settings)}
    for used in (track | staged, track):
        names = tuple(name for name in gestures() if name not in used)
        if len(names) >= _FEWEST:
            return names
    return tuple(gestures())


def _named(value: Any) -> Iterator[str]:
    """The gestures that settings of an effect name, at any depth."""
    if isinstance(value, Mapping):
        if isinstance(value.get("gesture"), str):
            yield value["gesture"]
        value = tuple(value.values())
    if isinstance(value, Sequence) and not isinstance(value, str):
        for item in value:
            yield from _named(item)


def free_moments(scene: Scene, count: int = FRAMES) -> list[dict[str, HandMoment]]:
    """The hands of every frame of the clip, by side.

    Place and heading are the track's at times spread over the capture, with a turn of the whole
    hand; joint angles are those of an unseen gesture, varied.
    """
    names = unseen_gestures(scene)
    frames = []
    orders = {
        side: generator(scene.seed, "free gestures", side).permutation(len(names))
        for side in scene.sides
    }
    for frame in range(count):
        seconds = (frame + 0.5) / count * scene.duration
        hands = {}
        for side, order in orders.items():
            rng = generator(scene.seed, "free pose", side, frame)
            shape = gestures()[names[order[frame % len(names)]]]
            moment = track_moment(scene, side, seconds)
            angles = within_limits(shape + rng.normal(0.0, _ANGLES, shape.shape))
            heading = moment.heading + rng.normal(0.0, _TURN, 3)
            hands[side] = HandMoment(angles, moment.place, heading)
        frames.append(hands)
    return frames


def camera_directions(scene: Scene, count: int = FRAMES) -> np.ndarray:
    """Directions from the hand to the camera of every frame: (count, 3) unit.

    The z axis points along the fingers. Directions are spread evenly over the sphere without the
    cone about the forearm: a Fibonacci lattice, turned and shuffled by the scene's seed.
    """
    rng = generator(scene.seed, "free cameras")
    lowest = -np.cos(np.radians(FOREARM_CONE))
    height = lowest + (1.0 - lowest) * (np.arange(count) + 0.5) / count
    azimuth = _GOLDEN * np.arange(count) + rng.uniform(0.0, 2.0 * np.pi)
    around = np.sqrt(1.0 - height**2)
    lattice = np.stack([around * np.cos(azimuth), around * np.sin(azimuth), height], axis=1)
    return lattice[rng.permutation(count)]


def hand_axes(hands: Mapping[str, HandMoment]) -> np.ndarray:
    """Axes of `camera_directions` in the world, as columns: (3, 3).

    z points along the fingers, of both hands on the average, y along the back of the first
    hand, perpendicular to them.
    """
    turns = [(side, heading_matrix(moment.heading, side)) for side, moment in hands.items()]
    # At rest the fingers of the right hand point along -x, those of the left along +x.
    fingers = [turn[:, 0] * (-1.0 if side == "right" else 1.0) for side, turn in turns]
    along = np.sum(fingers, axis=0)
    if np.linalg.norm(along) < 0.2:  # hands that point away from each other
        along = fingers[0]
    along = unit(along)
    back = turns[0][1][:, 1]
    back = back - (back @ along) * along
    if np.linalg.norm(back) < 1e-6:
        back = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    back = unit(back)
    return np.stack([np.cross(back, along), back, along], axis=1)


def looking_at(center: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """(4, 4) world to camera of a camera at `eye` that looks at `center`, both (3,) m.

    The image stands upright (the world's y points down), whatever the direction.
    """
    forward = unit(center - eye)
    down = np.array([0.0, 1.0, 0.0])
    if abs(forward @ down) > 0.999:
        down = np.array([0.0, 0.0, 1.0])
    right = unit(np.cross(down, forward))
    turn = np.stack([right, np.cross(forward, right), forward])
    view = np.eye(4)
    view[:3, :3] = turn
    view[:3, 3] = -turn @ eye
    return view


@dataclass(frozen=True, eq=False)
class FreeView:
    """One frame of a clip before it is rendered."""

    #: What the hands do, by side.
    hands: dict[str, HandMoment]
    #: (4, 4) world to camera.
    view: np.ndarray


def free_views(scene: Scene, count: int = FRAMES) -> list[FreeView]:
    """The hands and the camera of every frame of the clip.

    Two hands keep `GAP` between them. The camera looks at the middle of the hands from the
    distance of the scene's own camera, or from farther away where they would not fit.
    """
    directions = camera_directions(scene, count)
    return [
        _view(scene, _apart(scene, hands), direction)
        for hands, direction in zip(free_moments(scene, count), directions, strict=True)
    ]


def _view(scene: Scene, hands: dict[str, HandMoment], direction: np.ndarray) -> FreeView:
    points = np.concatenate(list(_surfaces(scene, hands).values()))
    center = (points.min(axis=0) + points.max(axis=0)) / 2.0
    towards = hand_axes(hands) @ direction
    distance = FOCUS_DISTANCE
    focal = intrinsics(scene, 1)[0, 0]
    for _ in range(8):  # nearly linear in the distance
        view = looking_at(center, center + distance * towards)
        seen = points @ view[:3, :3].T + view[:3, 3]
        farthest = focal * np.abs(seen[:, :2] / seen[:, 2:]).max()
        if farthest <= REACH:
            break
        distance *= farthest / REACH
    return FreeView(hands, view)


def _surfaces(scene: Scene, hands: Mapping[str, HandMoment]) -> dict[str, np.ndarray]:
    """Vertices of the posed hands before they are refined, by side: (T, 3) m each."""
    found = {}
    for side, subject in scene_hands(scene).items():
        pose, transl = hand_parameters(hands[side], side, subject.joints)
        found[side] = template_vertices(subject.tensors, pose, subject.betas, transl)
    return found


def _apart(scene: Scene, hands: dict[str, HandMoment]) -> dict[str, HandMoment]:
    """The hands, pushed apart along the line between them until `GAP` is between them."""
    if len(hands) < 2:
        return hands
    (first, one), (second, other) = hands.items()
    surfaces = _surfaces(scene, hands)
    line = one.place - other.place
    line = unit(line) if np.linalg.norm(line) > 1e-3 else np.array([1.0, 0.0, 0.0])
    tree, push = kd_tree(surfaces[second]), 0.0
    # Surfaces that cross have no distance either: what is between them must open along the line.
    while tree.query(surfaces[first] + push * line)[0].min() < GAP:
        push += GAP / 2.0
    half = push / 2.0 * line
    moved = (replace(one, place=one.place + half), replace(other, place=other.place - half))
    return dict(zip((first, second), moved, strict=True))


def has_free_view(capture: Path) -> bool:
    """Whether a capture folder holds a clip of this version that can be opened."""
    try:
        clip = open_capture(capture / FREE_VIEW)
    except HwpError:
        return False
    return clip.info.source.get("version") == VERSION


def free_file(folder: Path, frame: int) -> Path:
    """Path of a frame of the clip that waits for its capture."""
    return folder / f"free{VERSION}-{frame:06d}.npz"


def render_waiting_free(
    scene: Scene, frames: Sequence[int], size: int, folder: Path
) -> Iterator[int]:
    """Render frames of the clip into the folder where they wait; gives the number of each."""
    gain, views = steady_gain(scene, RenderCost()), free_views(scene)
    for frame in frames:
        cost = RenderCost()
        item, rgb, coverage = render_free(scene, views[frame], size, gain, cost)
        spent = json.dumps({"seconds": dict(cost.seconds), "rays": dict(cost.rays)})
        buffer = io.BytesIO()
        np.savez(
            buffer,
            rgb=rgb,
            coverage=eight_bit_coverage(coverage),
            view=item.view,
            cost=np.frombuffer(spent.encode(), dtype=np.uint8),
        )
        atomic_write(free_file(folder, frame), buffer.getvalue())
        yield frame


def read_waiting(path: Path) -> dict[str, np.ndarray] | None:
    """Read a finished frame of capture or clip; None if it is missing or damaged."""
    try:
        return read_npz(path)
    except BadInput:
        return None


def add_free_view(
    scene: Scene, folder: Path, info: CaptureInfo, estimates: Mapping[str, HandParameters]
) -> None:
    """Render the clip of a capture that exists into a folder."""
    with (
        scratch_folder("hwp-free-") as waiting,
        progress(f"Rendering the free view of {scene.id}", FRAMES) as update,
    ):
        for frame in render_waiting_free(scene, range(FRAMES), info.width, waiting):
            update(frame + 1)
        write_free_view(scene, folder, info, estimates, waiting)


def write_free_view(
    scene: Scene,
    folder: Path,
    info: CaptureInfo,
    estimates: Mapping[str, HandParameters],
    waiting: Path,
) -> None:
    """Write the clip of a capture into a folder, of the frames that wait in another one.

    It has the betas of the capture's estimates, because an avatar has one shape; angles are true,
    and the middle of the palm is in its true place. `truth/hands.npz` has the true betas too.
    """
    views, size, cost = free_views(scene), info.width, RenderCost()
    pictures = []
    for frame, item in enumerate(views):
        arrays = read_waiting(free_file(waiting, frame))
        if arrays is None:
            problem = f"frame {frame} of the free view was lost before the capture was whole"
            raise HwpError(problem, where=waiting, remedy="Start again: what is there is kept.")
        views[frame] = FreeView(item.hands, arrays["view"])
        pictures.append((arrays["rgb"], arrays["coverage"]))
        spent = json.loads(arrays["cost"].tobytes())
        cost.rays.update(spent["rays"])
        for name, seconds in spent["seconds"].items():
            cost.seconds[name] += seconds
    cameras = Cameras(
        Ks=np.repeat(intrinsics(scene, size)[None], len(views), axis=0),
        viewmats=np.stack([item.view for item in views]),
    )
    betas = {side: hand.betas for side, hand in estimates.items()}
    moments = [item.hands for item in views]
    given, truth = (parameters_of(scene, moments, shapes) for shapes in (betas, None))
    with CaptureWriter(folder, _info(info, len(views)), given, cameras, overwrite=True) as writer:
        for frame, (rgb, coverage) in enumerate(pictures):
            writer.frame(frame, rgb)
            writer.mask(frame, coverage)
            writer.true_mask(frame, coverage)
        writer.true_hands(truth)
        spent = {"seconds": dict(cost.seconds), "rays": dict(cost.rays)}
        writer.extra("cost.json", json.dumps(spent))


def render_free(
    scene: Scene, item: FreeView, size: int, gain: np.ndarray, cost: RenderCost
) -> tuple[FreeView, np.ndarray, np.ndarray]:
    """Render one frame of the clip: the frame with the camera that was taken, image, and coverage.

    Where the hand is hidden, by the sleeve or by what is worn, the camera moves towards the
    fingers until some of it is seen.
    """
    for move in range(_MOVES + 1):
        rgb, coverage = render_view(scene, item.hands, item.view, size, gain, cost)
        if move == _MOVES or (eight_bit_coverage(coverage) == 255).mean() >= LEAST_HAND:
            break
        axes = hand_axes(item.hands)
        towards = -item.view[2, :3] @ axes
        item = _view(scene, item.hands, unit(towards + np.array([0.0, 0.0, 1.0])))
    return item, rgb, coverage


def _info(info: CaptureInfo, count: int) -> CaptureInfo:
    """The clip's own description."""
    return replace(
        info,
        id=f"{info.id[: MAX_ID - len(FREE_VIEW) - 1]}-{FREE_VIEW}",
        frame_count=count,
        perturbations={},
        source={**info.source, "kind": KIND, "version": VERSION},
        digests=None,
    )
