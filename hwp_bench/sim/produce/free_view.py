"""The free-view clip of a capture: unseen poses, cameras all around, truth for every pixel.

It lies in a folder of its own inside the capture, as a small capture, and is not a part of the
capture's digest. Objects, blur, noise and compression are absent, and hand parameters are true, so
that it measures the avatar alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hwp_bench.base.console import progress
from hwp_bench.base.errors import HwpError
from hwp_bench.base.numerics import kd_tree
from hwp_bench.capture import Cameras, Capture, CaptureInfo, CaptureWriter, open_capture
from hwp_bench.capture.schema import FREE_VIEW, MAX_ID
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.geometry.raycast import RenderCost
from hwp_bench.sim.produce.frames import eight_bit_coverage
from hwp_bench.sim.render.view import render_view, steady_gain
from hwp_bench.sim.scene.free_view import (
    FRAMES,
    camera_directions,
    free_moments,
    hand_axes,
    looking_at,
)
from hwp_bench.sim.scene.motion import HandMoment, hand_parameters
from hwp_bench.sim.scene.optics import FOCUS_DISTANCE, focus_point, intrinsics
from hwp_bench.sim.scene.schema import Scene
from hwp_bench.sim.subject.hand import scene_hands, template_vertices

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

    Args:
        scene: the scene.
        count: frames.
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
        pose, transl = hand_parameters(hands[side], side, subject.joints, focus_point())
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
    return {
        first: replace(one, place=one.place + half),
        second: replace(other, place=other.place - half),
    }


def has_free_view(capture: Path) -> bool:
    """Whether a capture folder holds a clip of this version that can be opened."""
    try:
        clip = open_capture(capture / FREE_VIEW)
    except HwpError:
        return False
    return clip.info.source.get("version") == VERSION


def add_free_view(scene: Scene, capture: Capture) -> None:
    """Render the clip into a capture of this scene that has none.

    Raises:
        HwpError: it cannot be written.
    """
    write_free_view(scene, capture.root / FREE_VIEW, capture.info, capture.hands)


def write_free_view(
    scene: Scene, folder: Path, info: CaptureInfo, estimates: Mapping[str, HandParameters]
) -> None:
    """Render the clip.

    Args:
        scene: the scene.
        folder: where it goes; an existing clip is replaced.
        info: description of the capture that it belongs to.
        estimates: hand parameters that a method gets in that capture, by side. The clip has their
            betas, because an avatar has one shape; angles are true, and the middle of the palm
            is in its true place. `truth/hands.npz` has the true betas too.

    Raises:
        HwpError: it cannot be written.
    """
    cost = RenderCost()
    gain = steady_gain(scene, cost)
    views = free_views(scene)
    size = info.width
    pictures = []
    with progress(f"Rendering the free view of {scene.id}", len(views)) as update:
        for done, item in enumerate(views, start=1):
            pictures.append(render_free(scene, item, size, gain, cost))
            update(done)
    views = [view for view, _, _ in pictures]
    cameras = Cameras(
        Ks=np.repeat(intrinsics(scene, size)[None], len(views), axis=0),
        viewmats=np.stack([item.view for item in views]),
    )
    betas = {side: hand.betas for side, hand in estimates.items()}
    given, truth = (_parameters(scene, views, shapes) for shapes in (betas, None))
    with CaptureWriter(folder, _info(info, len(views)), given, cameras, overwrite=True) as writer:
        for frame, (_, rgb, coverage) in enumerate(pictures):
            writer.frame(frame, rgb)
            writer.mask(frame, eight_bit_coverage(coverage))
            writer.true_mask(frame, eight_bit_coverage(coverage))
        writer.true_hands(truth)
        spent = {"seconds": dict(cost.seconds), "rays": dict(cost.rays)}
        writer.extra("cost.json", json.dumps(spent))


def render_free(
    scene: Scene, item: FreeView, size: int, gain: np.ndarray, cost: RenderCost
) -> tuple[FreeView, np.ndarray, np.ndarray]:
    """Render one frame of the clip.

    Where the hand is hidden, by the sleeve or by what is worn, the camera moves towards the
    fingers until some of it is seen.

    Returns:
        the frame with the camera that was taken, (S, S, 3) uint8 sRGB, (S, S) coverage 0-1.
    """
    for _ in range(_MOVES):
        rgb, coverage = render_view(scene, item.hands, item.view, size, gain, cost)
        if (eight_bit_coverage(coverage) == 255).mean() >= LEAST_HAND:
            break
        axes = hand_axes(item.hands)
        towards = -item.view[2, :3] @ axes
        item = _view(scene, item.hands, unit(towards + np.array([0.0, 0.0, 1.0])))
    return item, rgb, coverage


def _parameters(
    scene: Scene, views: list[FreeView], betas: Mapping[str, np.ndarray] | None
) -> dict[str, HandParameters]:
    """Hand parameters of every frame, by side, with these betas or the true ones."""
    found = {}
    for side, subject in scene_hands(scene).items():
        shape = subject.betas if betas is None else betas[side]
        joints = subject.model_joints
        if betas is not None:
            joints = subject.model.joints + subject.model.joint_basis @ shape
        rows = [hand_parameters(item.hands[side], side, joints, focus_point()) for item in views]
        found[side] = HandParameters(
            pose=np.stack([pose for pose, _ in rows]),
            betas=shape,
            transl=np.stack([transl for _, transl in rows]),
            valid=np.ones(len(views), dtype=bool),
        )
    return found


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
