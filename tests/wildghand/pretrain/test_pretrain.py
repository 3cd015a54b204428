"""A prior over subjects: made of two, it helps a fit of a third, and bad ones are refused.

Oracles: the fit from random weights, the run that was never stopped, the weights as they were
written. The three subjects have one texture on their skin and tones of their own.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from painted import FRAMES, SilentReport, cameras, hand_parameters, painted_info
from safetensors.torch import load_file, save_file
from tiny_fits import TINY

import wildghand
from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.files import sha256_file
from hwp_bench.base.images import read_gray, read_rgb
from hwp_bench.capture import Capture, CaptureWriter, HandModelId, open_capture
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.methods.contract import Budget, RunSettings, TrainingCapture
from hwp_bench.methods.request import open_request, write_request
from wildghand.avatar.files import load_avatar
from wildghand.cli.main import main
from wildghand.fitting.components import make_fit
from wildghand.fitting.fit import Fit, StepBatch
from wildghand.fitting.session import load_state, save_state
from wildghand.from_video.run import VideoFit
from wildghand.model.settings import read_settings
from wildghand.network import network_settings
from wildghand.plain.loop import Watchers, run_fit
from wildghand.pretrain.pretrain import JointFit
from wildghand.prior.prior import DESCRIPTION, WEIGHTS, choose_prior, find_prior, load_prior

QUICK: dict[str, Any] = {**TINY, "gaussians": 400, "schedule.steps": 40}
NETWORK = network_settings(identity_resolution=24, plane_resolution=12)
CPU = torch.device("cpu")
#: Gains of the tones of the subjects; the last one is not pretrained on.
TONES = {"anna": (1.0, 1.0, 1.0), "ben": (0.7, 0.75, 0.85), "dora": (0.85, 0.8, 0.7)}


@pytest.fixture(scope="module")
def subjects(
    make_painted: Callable[..., Capture], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """Three people: the painted hand in tones of their own."""
    painted, root = make_painted(), tmp_path_factory.mktemp("subjects")
    return {name: _toned(painted, root / name, gains) for name, gains in TONES.items()}


def _toned(painted: Capture, path: Path, gains: tuple[float, ...]) -> Path:
    info = painted_info(path.name)
    with CaptureWriter(path, info, {"right": hand_parameters("right", 0)}, cameras()) as writer:
        for frame in range(FRAMES):
            image = read_rgb(painted.root / "frames" / f"{frame:06d}.png")
            writer.frame(frame, (image * np.array(gains)).astype(np.uint8))
            writer.mask(frame, read_gray(painted.root / "masks" / f"{frame:06d}.png"))
    return path


def training_of(source: Path, folder: Path) -> TrainingCapture:
    capture = open_capture(source)
    split = contiguous_split(capture.info.id, FRAMES)
    run = RunSettings(dict(QUICK), 0, Budget())
    return open_request(write_request(folder / capture.info.id, capture, split, run))


def make_prior(subjects: dict[str, Path], out: Path, *words: str) -> int:
    options = [word for name, value in QUICK.items() for word in ("--set", f"{name}={value}")]
    pair = [str(subjects["anna"]), str(subjects["ben"])]
    return main(["pretrain", *pair, "-o", str(out), "--steps", "60", *options, *words])


@pytest.fixture(scope="module")
def prior(subjects: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("prior") / "prior"
    assert make_prior(subjects, out) == 0
    return out


def mean_loss(fit: Fit) -> float:
    """L1 + D-SSIM over all training frames, without steps."""
    with torch.no_grad():
        losses = []
        for row in range(len(fit.data.frames)):
            rows = torch.tensor([row])
            drawing = fit.draw(StepBatch(rows))
            target = fit.compare(StepBatch(rows), drawing)
            terms = (
                t for c in fit.components for t in c.loss(fit, StepBatch(rows), drawing, target)
            )
            losses.append(torch.stack(list(terms)).sum())
        return float(torch.stack(losses).mean())


def test_a_prior_of_two_subjects_helps_a_third(
    subjects: dict[str, Path], prior: Path, tmp_path: Path
) -> None:
    training = training_of(subjects["dora"], tmp_path)
    # Without the light of the clip, which tells both most of what a prior of 60 steps knows.
    alone = {**QUICK, "shadows.enabled": False}
    plain = make_fit(training, read_settings(alone), 0, CPU)
    ahead = make_fit(training, read_settings({**alone, "prior": str(prior)}), 0, CPU)
    assert mean_loss(ahead) < 0.8 * mean_loss(plain)
    # And it stays ahead while both are fitted.
    for fit in (plain, ahead):
        for step in range(8):
            fit.step(torch.tensor([4 * step]), step / 8)
    assert mean_loss(ahead) < mean_loss(plain)


def test_a_prior_is_read_as_it_was_written(subjects: dict[str, Path], prior: Path) -> None:
    hand_model = open_capture(subjects["anna"]).info.hand_model
    read = load_prior(prior, NETWORK, hand_model)
    assert read.record.sides == ["right"]
    assert read.record.steps == 60
    assert [capture["id"] for capture in read.record.captures] == ["anna", "ben"]
    assert read.record.weights == sha256_file(prior / WEIGHTS)
    stored = load_file(prior / WEIGHTS)
    assert all(value.dtype == torch.float16 for value in stored.values())
    assert all(torch.equal(stored[name].float(), value) for name, value in read.tensors.items())


def test_maps_are_averaged_and_a_hand_not_seen_takes_the_other_ones(
    subjects: dict[str, Path], prior: Path, tmp_path: Path, make_training: Callable[..., Any]
) -> None:
    joint = JointFit(
        [training_of(subjects[name], tmp_path) for name in ("anna", "ben")],
        read_settings(QUICK),
        0,
        CPU,
    )
    weights, _ = run_fit(joint, Budget(steps=4), SilentReport())
    first, second = (fit.model.network for fit in joint.fits)
    assert first.texture_branch is second.texture_branch
    maps = [network.identity("right").detach() for network in (first, second)]
    assert not torch.equal(*maps)
    torch.testing.assert_close(
        weights["identity.maps.right"], (maps[0] + maps[1]) / 2, rtol=0, atol=1e-7
    )
    both = make_training("both")
    # Frames' colours would change the maps of the two hands apart.
    settings = read_settings({**QUICK, "prior": str(prior), "start_colors": False})
    network = make_fit(both, settings, 0, CPU).model.network
    assert torch.equal(network.identity("left"), network.identity("right"))


def test_the_same_seed_repeats_and_a_stopped_run_goes_on(
    subjects: dict[str, Path], tmp_path: Path
) -> None:
    trainings = [training_of(subjects[name], tmp_path) for name in ("anna", "ben")]
    settings = read_settings(QUICK)
    whole, half, rest = (JointFit(trainings, settings, 0, CPU) for _ in range(3))
    budget, watchers = Budget(steps=13), Watchers()
    expected_weights, _ = run_fit(whole, budget, SilentReport())

    class Stopped(Exception):
        pass

    def stop(step: int, watchers: Watchers, loss: object) -> None:
        if step == 7:
            save_state(tmp_path / "state", half, watchers, step=7, seconds=1.0, digest="d")
            raise Stopped

    with pytest.raises(Stopped):
        run_fit(half, budget, SilentReport(), watchers=watchers, after_step=stop)
    resumed = Watchers()
    assert load_state(tmp_path / "state", rest, resumed, "d") == (7, 1.0)
    weights, steps = run_fit(rest, budget, SilentReport(), start=7, watchers=resumed)
    assert steps == 13
    expected, found = whole.snapshot(), rest.snapshot()
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    assert all(torch.equal(expected_weights[name], value) for name, value in weights.items())


@pytest.mark.parametrize(
    ("changes", "each"), [({"schedule.epochs": 3}, None), ({"schedule.steps": 7}, 7)], ids=str
)
def test_a_run_without_a_number_has_the_steps_of_a_fit_for_each_capture(
    changes: dict[str, int], each: int | None, subjects: dict[str, Path], tmp_path: Path
) -> None:
    # Oracle: one frame a step, so that an epoch has as many steps as there are training frames.
    trainings = [training_of(subjects[name], tmp_path) for name in ("anna", "ben")]
    joint = JointFit(trainings, read_settings({**QUICK, **changes}), 0, CPU)
    expected = sum(each or 3 * len(training.train) for training in trainings)
    assert joint.count_steps(Budget()) == expected
    assert joint.count_steps(Budget(steps=5)) == 5


def test_a_prior_says_which_settings_ran_and_refuses_others(
    subjects: dict[str, Path], prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    schedule = json.loads((prior / DESCRIPTION).read_text())["settings"]["schedule"]
    fixed = {"texture_every": 1, "average_share": 0.0, "validated": False}
    assert {name: schedule[name] for name in fixed} == fixed
    for word in ("texture_every=8", "average_share=0.1", "validated=true"):
        assert make_prior(subjects, tmp_path / "other", "--set", f"schedule.{word}") == 2
        assert f"schedule.{word.partition('=')[0]}" in capsys.readouterr().err


def test_the_commands_use_a_prior(
    subjects: dict[str, Path], prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [word for name, value in QUICK.items() for word in ("--set", f"{name}={value}")]
    words = ["fit", str(subjects["dora"]), "-o", str(tmp_path / "avatar"), "--steps", "3"]
    assert main([*words, "--prior", str(prior), *options]) == 0
    avatar = load_avatar(tmp_path / "avatar")
    assert avatar.record.source["prior"] == sha256_file(prior / WEIGHTS)
    capsys.readouterr()
    assert make_prior(subjects, prior) == 2
    assert "exists" in capsys.readouterr().err
    assert main(["pretrain", str(subjects["anna"]), "-o", str(tmp_path / "one")]) == 2
    assert "several people" in capsys.readouterr().err


def test_a_prior_of_another_kind_is_refused(prior: Path, subjects: dict[str, Path]) -> None:
    hand_model = open_capture(subjects["anna"]).info.hand_model
    with pytest.raises(BadInput, match="identity_resolution = 24, and this fit has 160"):
        load_prior(prior, network_settings(), hand_model)
    with pytest.raises(BadInput, match="hand model anny"):
        load_prior(prior, NETWORK, HandModelId("mano", "0" * 64))


def _record(folder: Path, **changes: Any) -> None:
    value = json.loads((folder / DESCRIPTION).read_text())
    (folder / DESCRIPTION).write_text(json.dumps({**value, **changes}))


def _tensors(folder: Path, name: str, value: torch.Tensor | None) -> None:
    tensors = load_file(folder / WEIGHTS)
    tensors.pop(name, None)
    if value is not None:
        tensors[name] = value
    save_file(tensors, folder / WEIGHTS)
    _record(folder, weights=sha256_file(folder / WEIGHTS))


MAP = "identity.maps.right"
HARM: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no json": (lambda p: (p / DESCRIPTION).write_text("{"), "is not valid JSON"),
    "deep": (lambda p: (p / DESCRIPTION).write_text("[" * 5000), "prior.json"),
    "empty": (lambda p: (p / DESCRIPTION).write_text("{}"), "is missing"),
    "schema": (lambda p: _record(p, schema="wildghand-prior/9"), "wildghand-prior/9"),
    "sides": (lambda p: _record(p, sides=["third"]), "third"),
    "size": (lambda p: _record(p, network={"size": "huge"}), "huge"),
    "no weights": (lambda p: (p / WEIGHTS).unlink(), "is missing or larger"),
    "other weights": (lambda p: (p / WEIGHTS).write_bytes(b"x" * 99), "another digest"),
    "no tensor": (lambda p: _tensors(p, MAP, None), "maps.right: is missing"),
    "a tensor more": (lambda p: _tensors(p, "more", torch.ones(1)), "more: is not known"),
    "shape": (lambda p: _tensors(p, MAP, torch.ones(3, 3)), r"\(3, 3\), not \(576, 33\)"),
    "whole": (lambda p: _tensors(p, MAP, torch.ones(576, 33).int()), "int32"),
    "nan": (lambda p: _tensors(p, MAP, torch.full((576, 33), torch.nan)), "NaN"),
}


@pytest.mark.parametrize("harm", HARM)
def test_damaged_priors_are_one_line(
    harm: str, prior: Path, subjects: dict[str, Path], tmp_path: Path
) -> None:
    import shutil

    hand_model = open_capture(subjects["anna"]).info.hand_model
    folder = Path(shutil.copytree(prior, tmp_path / "prior"))
    spoil, message = HARM[harm]
    spoil(folder)
    with pytest.raises(BadInput, match=message) as caught:
        load_prior(folder, NETWORK, hand_model)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["../outside", "priors/none", "a\0b", "/nowhere/at/all"])
def test_priors_are_found_in_the_package_or_by_an_absolute_path(name: str) -> None:
    with pytest.raises(BadInput, match="is not a prior") as caught:
        find_prior(name)
    assert "\n" not in str(caught.value)


def test_an_absolute_path_is_taken(prior: Path) -> None:
    assert find_prior(str(prior)) == prior


def test_the_prior_that_ships_is_taken_where_it_fits(subjects: dict[str, Path]) -> None:
    hand_model = open_capture(subjects["anna"]).info.hand_model
    shipped = choose_prior(read_settings({}), hand_model)
    assert shipped is not None
    assert shipped.record.sides == ["right", "left"]
    assert len(shipped.record.captures) >= 8
    # Where the kind is another one nobody asked for it; where it is named, that is an error.
    assert choose_prior(read_settings(QUICK), hand_model) is None
    assert choose_prior(read_settings({}), HandModelId("mano", "0" * 64)) is None
    # The paper's start is pretrained, too; of its own network there is no prior.
    assert choose_prior(read_settings({"mode": "paper"}), hand_model) is not None
    assert choose_prior(read_settings({"network.size": "paper"}), hand_model) is None
    assert choose_prior(read_settings({"prior": ""}), hand_model) is None
    # A video's fit has opacities of the other kind, of the same weights.
    video = read_settings(VideoFit().method_settings())
    assert choose_prior(video, hand_model) is not None
    with pytest.raises(BadInput, match="hand model anny"):
        choose_prior(read_settings({"prior": "priors/compact"}), HandModelId("mano", "0" * 64))


def test_the_prior_that_ships_saw_no_subject_and_no_scene_of_a_suite(
    subjects: dict[str, Path],
) -> None:
    from hwp_bench.sim.scene_files import load_scene, scene_names

    shipped = choose_prior(read_settings({}), open_capture(subjects["anna"]).info.hand_model)
    assert shipped is not None
    scenes = [load_scene(name) for name in scene_names()]
    made = Path(wildghand.__file__).parent / "priors" / "scenes"
    quiet = [load_scene(str(path)) for path in sorted(made.glob("*.toml"))]
    assert not any(scene.effects for scene in quiet)
    sources = [capture["source"] for capture in shipped.record.captures]
    assert {source["scene"] for source in sources} == {scene.id for scene in quiet}
    assert {scene.id for scene in quiet}.isdisjoint(scene.id for scene in scenes)
    # A source's seed is that of its subject too (docs/prior.md).
    seeds = {source["seed"] for source in sources}
    assert len(seeds) == len(sources)
    assert seeds.isdisjoint(scene.seed for scene in scenes)
    assert seeds.isdisjoint(scene.subject.seed for scene in scenes)


def test_a_default_fit_starts_from_the_prior_that_ships(make_training: Callable[..., Any]) -> None:
    training = make_training("right")
    fit = make_fit(training, read_settings({"gaussians": 200}), 0, CPU)
    shipped = choose_prior(fit.settings, training.hand_model)
    assert shipped is not None
    assert fit.avatar(0).record.source["prior"] == shipped.record.weights
    # Start colours change channels of the map after the prior is there.
    untinted = make_fit(training, read_settings({"gaussians": 200, "start_colors": False}), 0, CPU)
    found = untinted.model.network.identity("right")
    torch.testing.assert_close(found, shipped.tensors[MAP], rtol=0, atol=0)
    bare = make_fit(training, read_settings({"gaussians": 200, "prior": ""}), 0, CPU)
    assert "prior" not in bare.avatar(0).record.source


def test_captures_of_different_hand_models_are_refused(
    subjects: dict[str, Path], make_capture: Callable[..., Capture], tmp_path: Path
) -> None:
    from wildghand.pretrain.pretrain import pretrain

    other = make_capture("other", frames=20)
    info = other.root / "capture.json"
    info.write_text(info.read_text().replace("anny-1", "mano"))
    with pytest.raises(UsageError, match="captures of one hand model"):
        pretrain([subjects["anna"], other.root], tmp_path / "p", settings=QUICK)
