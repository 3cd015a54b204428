"""The free-view clip: unseen poses, cameras all around, true parameters, apart from the capture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_scene import SceneMaker

from hwp_bench.base.errors import BadCapture
from hwp_bench.base.files import read_json, write_json
from hwp_bench.capture import Cameras, Capture, CaptureWriter, open_capture
from hwp_bench.capture.check import check_capture
from hwp_bench.capture.schema import FREE_VIEW
from hwp_bench.evaluation.scoring import read_targets, score_frames_of
from hwp_bench.importers.second_view import add_second_view
from hwp_bench.sim.produce import free_view
from hwp_bench.sim.produce.capture import render_capture
from hwp_bench.sim.produce.free_view import (
    FOREARM_CONE,
    FRAMES,
    GAP,
    REACH,
    camera_directions,
    free_views,
    has_free_view,
    looking_at,
    unseen_gestures,
)
from hwp_bench.sim.scene.scene import Scene, with_effects
from hwp_bench.sim.scene_files import load_scene, scene_names

COUNT, SIZE = 10, 48


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from tiny_scene import SINGLE

    from hwp_bench.sim.scene_files import parse_scene

    path = tmp_path_factory.mktemp("sim") / "tiny"
    scene = parse_scene(SINGLE, where="tiny.toml")
    render_capture(scene, path, frame_count=COUNT, size=SIZE, workers=1)
    return path


def _clip(folder: Path) -> Capture:
    clip = open_capture(folder).free_view
    assert clip is not None
    return clip


@settings(max_examples=20)
@given(seed=st.integers(0, 2**31))
def test_cameras_are_spread_over_the_sphere_without_the_forearm(seed: int) -> None:
    scene = replace(load_scene("capture2"), seed=seed)
    found = camera_directions(scene)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)
    assert found[:, 2].min() > -np.cos(np.radians(FOREARM_CONE))
    # Oracle: a uniform distribution. Bands of equal height have equal areas, and so as many
    # cameras; azimuths leave no quarter of a half empty.
    low = -np.cos(np.radians(FOREARM_CONE))
    bands = np.floor((found[:, 2] - low) / (1.0 - low) * 6).astype(int)
    assert np.bincount(bands).tolist() == [FRAMES // 6] * 6
    quarters = np.floor(np.arctan2(found[:, 1], found[:, 0]) / (np.pi / 2.0)).astype(int)
    for half in (found[:, 2] > found[:, 2].mean(), found[:, 2] <= found[:, 2].mean()):
        assert set(quarters[half]) == {-2, -1, 0, 1}
    # No two are neighbours: evenly spread caps would be 0.67 rad apart.
    angles = np.arccos(np.clip(found @ found.T - 2.0 * np.eye(FRAMES), -1.0, 1.0))
    assert angles.min() > 0.4
    np.testing.assert_array_equal(found, camera_directions(scene))


@settings(max_examples=30)
@given(
    eye=st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
)
def test_a_camera_sees_what_it_looks_at_in_the_middle(eye: tuple[float, float, float]) -> None:
    center = np.array([0.1, -0.2, 0.5])
    view = looking_at(center, center + np.array(eye))
    np.testing.assert_allclose(view[:3, :3] @ view[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(view[:3, :3]) > 0.99
    seen = view[:3, :3] @ center + view[:3, 3]
    np.testing.assert_allclose(seen, [0.0, 0.0, np.linalg.norm(eye)], atol=1e-9)
    # The world's down is never up in the image.
    assert view[1, 1] >= 0.0 or abs(view[2, 1]) > 0.999


@pytest.mark.parametrize("name", scene_names())
def test_gestures_are_those_that_the_scene_does_not_show(name: str) -> None:
    # Oracle: the text of the scene file.
    text = Path(load_scene.__code__.co_filename).with_name("scenes") / f"{name}.toml"
    shown = text.read_text("utf-8")
    found = unseen_gestures(load_scene(name))
    assert len(found) >= 4
    assert not [gesture for gesture in found if f'gesture = "{gesture}"' in shown]


def test_two_hands_keep_apart_and_fit_into_the_image() -> None:
    from scipy.spatial import cKDTree

    from hwp_bench.sim.scene.scene import intrinsics

    scene = load_scene("capture6")
    for item in free_views(scene, 3):
        surfaces = free_view._surfaces(scene, item.hands)
        right, left = surfaces["right"], surfaces["left"]
        assert cKDTree(left).query(right)[0].min() >= GAP
        points = np.concatenate([right, left]) @ item.view[:3, :3].T + item.view[:3, 3]
        pixels = points @ intrinsics(scene, 1).T
        places = pixels[:, :2] / pixels[:, 2:] - 0.5
        assert np.abs(places).max() < REACH + 0.01


def test_the_clip_is_a_capture_of_its_own(rendered: Path) -> None:
    capture, clip = open_capture(rendered), _clip(rendered)
    assert check_capture(clip.root).ok
    assert len(clip) == FRAMES
    assert clip.info.perturbations == {}
    assert clip.has_true_masks
    np.testing.assert_array_equal(clip.hands["right"].betas, capture.hands["right"].betas)
    poses = clip.hands["right"].pose[:, 1:]
    seen = capture.hands["right"].pose[:, 1:]
    # Degrees of the joint that differs most from the nearest frame of the capture.
    apart = np.degrees(np.abs(poses[:, None] - seen[None]).max(axis=(2, 3))).min(axis=1)
    assert apart.min() > 15.0
    for frame in range(FRAMES):
        assert (clip.mask(frame) == 255).mean() > 0.005


def test_the_given_hands_explain_the_masks(rendered: Path) -> None:
    # Oracle: the hand model itself, drawn by the toolkit's rasterizer.
    import torch

    from hwp_bench.hands import pose_hand, project
    from hwp_bench.hands.raster import draw_silhouette

    clip = _clip(rendered)
    hands = clip.hands["right"]
    posed = pose_hand(
        clip.template("right").to_torch(dtype=torch.float64),
        *(torch.as_tensor(array) for array in (hands.pose, hands.betas, hands.transl)),
    )
    pixels, _ = project(
        posed.vertices,
        torch.as_tensor(clip.cameras.viewmats),
        torch.as_tensor(clip.cameras.Ks),
    )
    overlap = []
    for frame in range(FRAMES):
        drawn = draw_silhouette(pixels[frame].numpy(), clip.template("right").faces, SIZE) > 0
        covered = clip.true_mask(frame) == 255
        # Relief and smoothing move the outline by less than a pixel here.
        assert drawn[covered].mean() > 0.97
        overlap.append(covered.sum() / drawn.sum())
    # Pixels of the border are covered in part, and the sleeve hides the wrist.
    assert np.median(overlap) > 0.75


def test_the_clip_is_no_part_of_the_capture(
    rendered: Path, make_scene: SceneMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hwp_bench.sim.produce import capture as production
    from hwp_bench.sim.produce import capture as suites

    item = suites.SuiteItem(make_scene(), COUNT, SIZE)
    (bare,) = suites.ensure_suite([item], tmp_path, workers=1, free_view=False)
    assert not (bare / FREE_VIEW).exists()
    assert open_capture(bare).digest == open_capture(rendered).digest
    assert open_capture(bare).free_view is None
    # A capture in the cache gets the clip, and is not rendered again.
    monkeypatch.setattr(production, "render_waiting", None)
    assert suites.ensure_suite([item], tmp_path, workers=1) == [bare]
    assert _clip(bare).digest == _clip(rendered).digest
    # A clip of an older version is replaced, one of this version is not.
    metadata = bare / FREE_VIEW / "capture.json"
    value = read_json(metadata)
    write_json(metadata, {**value, "source": {**value["source"], "version": 0}})
    assert not has_free_view(bare)
    suites.ensure_suite([item], tmp_path, workers=1)
    assert _clip(bare).digest == _clip(rendered).digest
    monkeypatch.setattr(free_view, "write_free_view", None)
    suites.ensure_suite([item], tmp_path, workers=1)


def test_effects_and_sensor_leave_the_clip_as_it_is(make_scene: SceneMaker) -> None:
    # None of the tiny scene's effects names a gesture.
    scene = make_scene()
    other = with_effects(make_scene(("noise = 0.01", "noise = 0.1")), ())
    assert unseen_gestures(scene) == unseen_gestures(other)
    for one, two in zip(free_views(scene, 3), free_views(other, 3), strict=True):
        np.testing.assert_array_equal(one.view, two.view)
        results = [
            free_view.render_free(each, item, SIZE, np.ones(3), free_view.RenderCost())
            for each, item in ((scene, one), (other, two))
        ]
        np.testing.assert_array_equal(results[0][1], results[1][1])


def test_a_hidden_hand_makes_the_camera_move(
    make_scene: SceneMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hwp_bench.sim.produce.free_view import hand_axes

    scene = make_scene()
    (item, *_) = free_views(scene, 6)
    empty = np.zeros((SIZE, SIZE))
    seen: list[np.ndarray] = []

    def render_view(scene: Scene, hands: object, view: np.ndarray, *rest: object) -> object:
        seen.append(view)
        return empty, empty

    monkeypatch.setattr(free_view, "render_view", render_view)
    moved, _, _ = free_view.render_free(scene, item, SIZE, np.ones(3), free_view.RenderCost())
    # The camera that is told is the one of the image, though it never saw enough.
    np.testing.assert_array_equal(moved.view, seen[-1])
    along = [-view.view[2, :3] @ hand_axes(item.hands)[:, 2] for view in (item, moved)]
    assert along[1] > max(along[0], 0.9)


def test_a_clip_of_another_capture_is_refused(rendered: Path, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(rendered, tmp_path / "copy")
    metadata = tmp_path / "copy" / FREE_VIEW / "capture.json"
    write_json(metadata, {**read_json(metadata), "width": SIZE + 1})
    with pytest.raises(BadCapture, match="capture around it") as caught:
        _ = open_capture(tmp_path / "copy").free_view
    assert caught.value.field == "width"


def test_a_second_camera_has_the_scores_of_the_simulators_own_clip(
    rendered: Path, tmp_path: Path
) -> None:
    simulated, clip = open_capture(rendered), _clip(rendered)
    # The scene's own camera films the hands of the clip; its pixels are not looked at.
    count = len(clip)
    cameras = Cameras(*(np.repeat(a[:1], count, axis=0) for a in vars(simulated.cameras).values()))
    info = replace(clip.info, id="front", digests=None)
    with CaptureWriter(tmp_path / "front", info, clip.hands, cameras) as writer:
        for frame in range(count):
            writer.frame(frame, np.zeros((SIZE, SIZE, 3), np.uint8))
            writer.mask(frame, np.full((SIZE, SIZE), 255, np.uint8))
    front = open_capture(tmp_path / "front")
    made = add_second_view(front, clip)
    assert (made.scale, made.distance_px, len(made.frames)) == (None, 0.0, count)
    real = _clip(front.root)
    for name in ("frames", "masks", "true_masks", "cameras", "hands"):
        assert (real.info.digests or {})[name] == (clip.info.digests or {})[name]
    folder = tmp_path / "drawn"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for frame in range(count):
        drawn = rng.integers(0, 255, (SIZE, SIZE, 3), np.uint8)
        cv2.imwrite(str(folder / f"{frame:06d}.png"), drawn)
    scores = [
        score_frames_of(read_targets(one, range(count)), folder, one.size).scores
        for one in (real, clip)
    ]
    assert scores[0] == scores[1]
    assert all(frame.failure is None for frame in scores[0])
