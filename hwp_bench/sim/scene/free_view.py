"""The free-view clip of a scene: poses that its track does not show, and cameras all around."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hwp_bench.hands.poses import gestures, within_limits
from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.scene.motion import HandMoment, heading_matrix, track_moment
from hwp_bench.sim.scene.schema import Scene

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

    Args:
        scene: the scene.
        count: frames.
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
            hands[side] = replace(
                moment,
                angles=within_limits(shape + rng.normal(0.0, _ANGLES, shape.shape)),
                heading=moment.heading + rng.normal(0.0, _TURN, 3),
            )
        frames.append(hands)
    return frames


def camera_directions(scene: Scene, count: int = FRAMES) -> np.ndarray:
    """Directions from the hand to the camera of every frame: (count, 3) unit.

    The z axis points along the fingers. Directions are spread evenly over the sphere without the
    cone about the forearm: a Fibonacci lattice, turned and shuffled by the scene's seed.

    Args:
        scene: the scene.
        count: frames.
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

    z points along the fingers, of both hands on the average, y is the back of the first hand as
    far as it is perpendicular to them.
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
