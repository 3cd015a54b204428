"""A whole fit at toy size: it learns, repeats, stops and goes on, and fails in one line.

Oracles: a capture drawn with the plain avatar, the fit that was never stopped, and the avatar
before it was written.
"""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.spatial
import torch
from painted import FRAMES, SIZE, SilentReport, TrainingMaker
from tiny_fits import QUICK

from hwp_bench.base.errors import BadInput, DidNotConverge, UsageError
from hwp_bench.base.images import read_rgb
from hwp_bench.base.records import flattened
from hwp_bench.capture import Capture
from hwp_bench.importers.video.decode import read_times
from hwp_bench.methods import find_method, read_manifest
from hwp_bench.methods.contract import Budget, TrainingCapture
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import load_avatar, save_avatar
from wildghand.cli.main import main
from wildghand.fitting import descent, fit_capture
from wildghand.fitting.components import make_fit
from wildghand.fitting.method import WildGHandMethod
from wildghand.fitting.parallel import World
from wildghand.fitting.session import load_state, save_state
from wildghand.gaussians.adam import ClippedAdam
from wildghand.model.model import WildGHandModel
from wildghand.model.settings import read_settings
from wildghand.plain.loop import Watchers, run_fit
from wildghand.splat import rasterize

FIT: dict[str, Any] = {**QUICK, "schedule.steps": 60}


def fitted(training: TrainingCapture, steps: int = 60, **changes: Any) -> WildGHandAvatar:
    return WildGHandMethod({**FIT, "schedule.steps": steps, **changes}, 0).fit(
        training, Budget(), SilentReport()
    )


def error(avatar: WildGHandAvatar, training: TrainingCapture, frame: int) -> float:
    truth = training.frame(frame).astype(float) / 255.0
    hand = training.mask(frame) > 127
    drawn = avatar.render(training.hand_poses(frame), training.camera(frame))[..., :3]
    return float(np.abs(drawn - truth)[hand].mean())


@pytest.mark.parametrize("hands", ["right", "both"])
def test_a_fit_learns_what_the_frames_show(
    hands: str, make_training: TrainingMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    training = make_training(hands)
    start, end = fitted(training, steps=1), fitted(training)
    before, after = (
        np.mean([error(avatar, training, int(frame)) for frame in training.validation])
        for avatar in (start, end)
    )
    assert after < 0.6 * before
    # So few Gaussians are thin, and the wall of the wrist, which no frame shows, shines through.
    monkeypatch.setattr(WildGHandModel, "walls", lambda *_: [])
    frame = int(training.validation[0])
    assert error(end, training, frame) < 0.6 * error(start, training, frame)
    assert end.steps == FIT["schedule.steps"]
    assert set(end.record.temporal) == set(training.sides)
    assert sorted(end.weight_masks) == end.record.frames == training.train.tolist()


@pytest.mark.parametrize(
    "changes",
    [
        {"dpd.enabled": False},
        {"pao.enabled": False},
        {"heads": False},
        {"pao.variant": "binary"},
        {"dpd.additions": False},
        {"mode": "paper", "schedule.epochs": 0},
        {"mode": "released", "schedule.epochs": 0},
        {"prepass.enabled": False},
    ],
    ids=str,
)
def test_every_variant_stays_finite(changes: dict[str, Any], make_training: TrainingMaker) -> None:
    training = make_training()
    whole = {"subject.enabled": False, "shadows.enabled": False}
    avatar = fitted(training, steps=12, **whole | changes)
    assert avatar.model.finite()
    image = avatar.render(training.hand_poses(0), training.camera(0))
    assert image.shape == (SIZE, SIZE, 4)
    assert np.isfinite(image).all()
    assert image[..., 3].max() > 0.5
    assert bool(avatar.record.temporal) == changes.get("dpd.enabled", True)


def test_the_same_seed_gives_the_same_bits_and_another_does_not(
    make_training: TrainingMaker,
) -> None:
    training = make_training()
    first, again = (fitted(training, steps=8).model.snapshot() for _ in range(2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    other = WildGHandMethod({**FIT, "schedule.steps": 8}, 1).fit(training, Budget(), SilentReport())
    assert any(not torch.equal(first[n], v) for n, v in other.model.snapshot().items())


def test_a_stopped_fit_goes_on_as_if_it_had_not_been(
    make_training: TrainingMaker, tmp_path: Path
) -> None:
    training, device = make_training(), torch.device("cpu")
    settings = read_settings({**FIT, "schedule.steps": 30})

    class Stopped(Exception):
        pass

    def stop(step: int, watchers: Watchers, loss: object) -> None:
        if step == 17:
            save_state(
                tmp_path / "state", half, watchers, step=step, seconds=1.5, digest="of this fit"
            )
            raise Stopped

    report = SilentReport()
    whole = run_fit(make_fit(training, settings, 0, device), Budget(), report)
    assert [step for step, _ in report.offers] == list(range(31))
    half = make_fit(training, settings, 0, device)
    with pytest.raises(Stopped):
        run_fit(half, Budget(), SilentReport(), after_step=stop)
    rest, watchers = make_fit(training, settings, 0, device), Watchers()
    assert load_state(tmp_path / "state", rest, watchers, "of this fit") == (17, 1.5)
    resumed = run_fit(rest, Budget(), SilentReport(), start=17, watchers=watchers)
    expected, found = whole.model.snapshot(), resumed.model.snapshot()
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    with pytest.raises(BadInput, match="another capture"):
        load_state(tmp_path / "state", rest, watchers, "of another")
    (tmp_path / "state").write_bytes(b"PK\x03\x04 no state")
    with pytest.raises(BadInput, match=r"state.*is damaged.*Remove it"):
        load_state(tmp_path / "state", rest, watchers, "of this fit")


def test_rates_far_too_high_stop_with_a_message_or_keep_the_best(
    make_training: TrainingMaker,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    training = make_training()
    for name in ("identity", "direct", "light", "network", "dpd"):
        monkeypatch.setitem(descent._RATES, name, 3.0)
    monkeypatch.setattr(descent, "_CLIP", 0.0)
    try:
        avatar = fitted(training, steps=150)
    except DidNotConverge:
        return
    assert avatar.model.finite()
    if avatar.steps < 150:
        assert "the state of step" in capsys.readouterr().err


@pytest.fixture
def spoil_gradients(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[int], bool]], None]:
    """Makes one number of a gradient infinite in the steps that a function names."""

    def spoil(spoiled: Callable[[int], bool]) -> None:
        take, steps = ClippedAdam.take_step, itertools.count()

        def spoil_and_take(optimizer: ClippedAdam, loss: torch.Tensor) -> torch.Tensor:
            if spoiled(next(steps)):
                (group, *_) = optimizer.param_groups
                group["params"][0].grad.view(-1)[-1] = np.inf
            return take(optimizer, loss)

        monkeypatch.setattr(ClippedAdam, "take_step", spoil_and_take)

    return spoil


BARE: dict[str, Any] = {"mode": "bare", "gaussians": 200}


@pytest.mark.parametrize("steps", [5, 60])
def test_a_fit_whose_every_gradient_is_infinite_ends_as_diverged(
    steps: int,
    make_training: TrainingMaker,
    spoil_gradients: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    training = make_training()
    spoil_gradients(lambda step: True)
    with pytest.raises(DidNotConverge, match="diverged within its first 50 steps"):
        fitted(training, steps, **BARE)
    assert capsys.readouterr().err == ""


def test_gradients_that_turn_infinite_end_a_fit_at_its_last_good_state(
    make_training: TrainingMaker,
    spoil_gradients: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    training = make_training()
    spoil_gradients(lambda step: step >= 50)
    avatar = fitted(training, 120, **BARE)
    assert avatar.steps == 50
    assert capsys.readouterr().err.count("The fit diverged") == 1


def test_a_few_skipped_steps_are_said_once(
    make_training: TrainingMaker,
    spoil_gradients: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    training = make_training()
    spoil_gradients(lambda step: step in (2, 5))
    avatar = fitted(training, 8, **BARE)
    assert avatar.steps == 8
    assert avatar.model.finite()
    said = capsys.readouterr().err.split("\n")
    assert said == ["2 of 8 steps were skipped: a gradient was not finite.", ""]


def test_an_avatar_is_read_as_it_was_written(make_training: TrainingMaker, tmp_path: Path) -> None:
    training = make_training("both")
    avatar = fitted(training, steps=5)
    save_avatar(avatar, tmp_path / "avatar")
    read = load_avatar(tmp_path / "avatar")
    poses, camera = training.hand_poses(3), training.camera(3)
    np.testing.assert_array_equal(avatar.render(poses, camera), read.render(poses, camera))
    assert read.record == avatar.record
    assert len(list((tmp_path / "avatar" / "weights").iterdir())) == len(avatar.record.frames)
    with pytest.raises(UsageError):
        save_avatar(avatar, tmp_path / "avatar")


@pytest.fixture(scope="module")
def saved(make_painted: Callable[..., Capture], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an avatar; tests that change it copy it."""
    avatar = tmp_path_factory.mktemp("saved") / "avatar"
    options = [word for name, value in FIT.items() for word in ("--set", f"{name}={value}")]
    capture = str(make_painted().root)
    assert main(["fit", capture, "-o", str(avatar), "--steps", "1", *options]) == 0
    return avatar


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("avatar.json", "{}", "is missing"),
        ("avatar.json", "[" * 5000, "avatar"),
        ("model.safetensors", "no tensors", "tensors"),
    ],
)
def test_damaged_avatars_are_one_line(
    name: str, content: str, message: str, saved: Path, tmp_path: Path
) -> None:
    shutil.copytree(saved, tmp_path / "avatar")
    (tmp_path / "avatar" / name).write_text(content)
    with pytest.raises(BadInput, match=message) as caught:
        load_avatar(tmp_path / "avatar")
    assert "\n" not in str(caught.value)


def test_the_commands_make_draw_and_export_an_avatar(
    make_painted: Callable[..., Capture], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture, avatar = make_painted().root, tmp_path / "avatar"
    options = [word for name, value in FIT.items() for word in ("--set", f"{name}={value}")]
    assert main(["fit", str(capture), "-o", str(avatar), "--steps", "5", *options]) == 0
    assert not (tmp_path / "avatar.fit").exists()
    assert "5 steps" in capsys.readouterr().out
    assert main(["fit", str(capture), "-o", str(avatar)]) == 2
    # The same call finds it complete, as after a kill in the last moment, and takes the state away.
    (tmp_path / "avatar.fit").mkdir()
    before = (avatar / "model.safetensors").stat().st_mtime_ns
    assert main(["fit", str(capture), "-o", str(avatar), "--steps", "5", *options]) == 0
    shown = capsys.readouterr()
    assert "is complete: the same call has made it" in shown.err
    assert not (tmp_path / "avatar.fit").exists()
    assert "5 steps" in shown.out
    assert (avatar / "model.safetensors").stat().st_mtime_ns == before
    pictures = tmp_path / "pictures"
    # Of a clip of uneven steps the video has its times.
    clip = Path(shutil.copytree(capture, tmp_path / "clip"))
    written = json.loads((clip / "capture.json").read_text())
    uneven = [0.05 * frame + 0.01 * (frame % 2) for frame in range(written["frame_count"])]
    (clip / "capture.json").write_text(json.dumps({**written, "times": uneven}))
    words = ["render", str(avatar), "--poses", str(clip), "-o", str(pictures)]
    assert main([*words, "--range", "2:5", "--video", str(tmp_path / "clip.mp4")]) == 0
    shown = read_times(tmp_path / "clip.mp4")
    np.testing.assert_allclose(shown, np.array(uneven[2:5]) - uneven[2], atol=1e-3)
    assert sorted(path.name for path in pictures.iterdir()) == [f"{f:06d}.png" for f in (2, 3, 4)]
    assert read_rgb(pictures / "000002.png").max() > 0
    assert (tmp_path / "clip.mp4").stat().st_size > 0
    assert main(["export", str(avatar), "-o", str(tmp_path / "hand.ply")]) == 0
    header, _, body = (tmp_path / "hand.ply").read_bytes().partition(b"end_header\n")
    count = len(load_avatar(avatar).pose(load_avatar(avatar).rest_poses(), closed=True))
    assert f"element vertex {count}".encode() in header
    # x y z, normal, f_dc, 45 of f_rest, opacity, scale, rotation.
    table = np.frombuffer(body, "<f4").reshape(count, 62)
    assert np.isfinite(table).all()
    np.testing.assert_allclose(np.linalg.norm(table[:, 58:], axis=1), 1.0, atol=1e-5)
    assert main(["render", str(avatar), "--poses", str(capture), "-o", "x", "--range", "9:99"]) == 2


def test_from_python_nothing_is_written(
    make_painted: Callable[..., Capture], tmp_path: Path
) -> None:
    source = make_painted().root
    before = sorted(path.name for path in source.parent.iterdir())
    changes = {**FIT, "schedule.steps": 3}
    avatar = fit_capture(source, settings=changes)
    written = fit_capture(str(source), str(tmp_path / "avatar"), settings=changes)
    assert sorted(path.name for path in source.parent.iterdir()) == before
    for name, value in avatar.model.snapshot().items():
        assert torch.equal(value, written.model.snapshot()[name])
    assert repr(avatar) == (
        "WildGHandAvatar(right hand of anny-1, 600 Gaussians each, 3 steps on 32 frames)"
    )
    with pytest.raises(UsageError, match="several processes"):
        fit_capture(source, settings={**changes, "schedule.batch": 2}, world=World(0, 2))


@pytest.mark.parametrize("hands", ["right", "both"])
def test_posed_gaussians_are_what_is_drawn(hands: str, make_training: TrainingMaker) -> None:
    training = make_training(hands)
    # With a light, colours depend on the camera, which a pose has not.
    avatar = fitted(training, steps=2, **{"light.enabled": False})
    # So do Gaussians of skin that no frame shows.
    avatar.model.keep(avatar.model.visibility.spare_all())
    poses, camera = training.hand_poses(3), training.camera(3)
    own, posed = avatar.pose(poses), avatar.pose(poses, closed=True)
    assert len(own) == len(training.sides) * FIT["gaussians"]
    # The walls that close the wrists come last.
    np.testing.assert_array_equal(posed.means[: len(own)], own.means)
    count = len(posed)
    assert count > len(own)
    shapes = [np.shape(array) for array in (posed.means, posed.quats, posed.scales, posed.colors)]
    assert shapes == [(count, 3), (count, 4), (count, 3), (count, 3)]
    assert posed.opacities.shape == (count,)
    np.testing.assert_allclose(np.linalg.norm(posed.quats, axis=1), 1.0, atol=1e-5)
    image, coverage, _ = rasterize(
        *(
            torch.from_numpy(array)[None]
            for array in (posed.means, posed.quats, posed.scales, posed.opacities, posed.colors)
        ),
        torch.from_numpy(camera.viewmat).float()[None],
        torch.from_numpy(camera.K).float()[None],
        camera.width,
        camera.height,
    )
    drawn = torch.cat((image, coverage), dim=-1)[0].clamp(0.0, 1.0).numpy()
    np.testing.assert_allclose(drawn, avatar.render(poses, camera), atol=1e-6)
    rest = avatar.gaussians
    assert len(rest) == len(own)
    # At rest every Gaussian lies near the template, whose shape `betas` moves by millimetres.
    vertices = np.concatenate(
        [
            training.template(side).vertices + avatar.rest_poses()[side].transl
            for side in training.sides
        ]
    )
    assert scipy.spatial.cKDTree(vertices).query(rest.means)[0].max() < 0.02


def test_the_wall_of_a_wrist_moves_with_the_refined_hand(
    make_training: TrainingMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    training = make_training()
    avatar = fitted(training, steps=2, **{"shadows.enabled": False})
    assert avatar.settings.heads
    own, before = (avatar.pose(training.hand_poses(3), closed=closed) for closed in (False, True))
    predict, shift = WildGHandModel.predict, torch.tensor([0.01, -0.02, 0.03])

    def moved(*args: Any) -> Any:
        made = predict(*args)
        refinement = replace(made.refinement, transl=made.refinement.transl + shift)
        return replace(made, refinement=refinement)

    monkeypatch.setattr(WildGHandModel, "predict", moved)
    after = avatar.pose(training.hand_poses(3), closed=True)
    assert len(before) > len(own)
    np.testing.assert_allclose(after.means - before.means, shift.expand(len(after), 3), atol=1e-5)


def test_settings_of_presets_and_switches() -> None:
    for name in ("wildghand", "network-scratch"):
        manifest = read_manifest(find_method(name))
        for preset in manifest.presets.values():
            read_settings(preset)
        for switch in manifest.switches.values():
            read_settings(switch.settings)
    base = read_manifest(find_method("network-scratch")).presets["mini"]
    assert not read_settings(base).dpd.enabled
    assert not read_settings(base).pao.enabled
    assert FRAMES > 0


def test_bases_of_ablations_name_the_components_that_their_modes_have() -> None:
    manifest = read_manifest(find_method("wildghand"))
    for base in manifest.bases.values():
        values = dict(flattened(asdict(read_settings(base.settings))))
        # The other hand's colours are found by what frames have shown.
        values["visibility.other_hand"] &= values["visibility.enabled"]
        for switch in manifest.switches.values():
            if not switch.alternative:
                out = all(values[name] == value for name, value in switch.settings.items())
                assert out != (switch.name in (*base.crossed, *base.kept)), (base.name, switch.name)
