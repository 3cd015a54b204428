"""SAM and VGG-19 in a fit, from the command lines. Oracles: fits without; the cache's files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from painted import FRAMES, TrainingMaker
from small_captures import split_file
from tiny_fits import TINY
from tiny_networks import write_sam_file, write_sam_folder, write_vgg19

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.capture import Capture
from hwp_bench.cli.main import main as hwp_bench
from hwp_bench.commitments.publication import open_captures
from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
from hwp_bench.evaluation.evaluate import make_plan, with_setting_files
from hwp_bench.methods import find_method, read_manifest
from hwp_bench.methods.contract import REQUEST, Budget, RunSettings, TrainingCapture
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import load_avatar
from wildghand.cli.main import main as wildghand
from wildghand.fitting import fit_capture
from wildghand.fitting.components import make_fit
from wildghand.fitting.fit import StepBatch
from wildghand.fitting.judging import hand_masks, hand_roots
from wildghand.fitting.method import WildGHandMethod, digest_of_named_files
from wildghand.fitting.session import digest_of_request
from wildghand.from_video import VideoFit
from wildghand.from_video.run import VideoJob
from wildghand.from_video.stages import FitStage
from wildghand.model.settings import read_settings
from wildghand.pao.sam import AutomaticSettings
from wildghand.prior.prior import DESCRIPTION

#: Bending and shadows come before what the networks are for, and take longer.
FIT: dict[str, Any] = {
    **TINY,
    "schedule.steps": 3,
    "subject.enabled": False,
    "shadows.enabled": False,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoints of every kind."""
    made = tmp_path_factory.mktemp("checkpoints")
    write_sam_file(made / "sam.pth")
    write_sam_folder(made / "sam")
    write_vgg19(made / "vgg19.pth")
    return made


@pytest.fixture
def _fewer_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Prompt a tenth of the points; the sandboxed fits prompt all of them."""
    monkeypatch.setattr("wildghand.pao.sam.PUBLIC", AutomaticSettings(points=10))


def weights(training: TrainingCapture, **changes: Any) -> torch.Tensor:
    fit = make_fit(training, read_settings({**FIT, **changes}), 0, torch.device("cpu"))
    rows = torch.arange(3)
    with torch.no_grad():
        return fit.compare(StepBatch(rows), fit.draw(StepBatch(rows))).weights


def options(settings: dict[str, Any]) -> list[str]:
    said = (f"{name}={json.dumps(value)}" for name, value in settings.items())
    return [word for each in said for word in ("--set", each)]


@pytest.mark.usefixtures("_fewer_points")
def test_regions_and_hand_reach_the_weights_and_are_found_once(
    folder: Path, make_training: TrainingMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Of the regions only: the cache also holds compiled kernels.
    monkeypatch.setattr("wildghand.pao.segmenters.cache_root", lambda: tmp_path / "cache")
    training = make_training()
    plain = weights(training, mode="paper")
    chosen = {"mode": "paper", "pao.regions": f"sam:{folder / 'sam.pth'}"}
    regions = weights(training, **chosen)
    assert not torch.equal(regions, plain)
    both = weights(training, **chosen, **{"pao.hand": f"sam:{folder / 'sam.pth'}"})
    assert not torch.equal(both, regions)
    kept = len(list((tmp_path / "cache" / "wildghand" / "regions").iterdir()))
    assert kept == 3 * len(training.train)  # superpixels, masks, hands

    def load(*_: object) -> None:
        raise AssertionError("the network was loaded again")

    monkeypatch.setattr("wildghand.pao.sam.load_network", load)
    again = weights(training, **chosen, **{"pao.hand": f"sam:{folder / 'sam.pth'}"})
    assert torch.equal(again, both)


@pytest.mark.parametrize("source", ["graph-cut", "sam"])
def test_the_binary_mask_is_the_hand_that_was_chosen(
    source: str, folder: Path, make_training: TrainingMaker
) -> None:
    training = make_training()
    hand = f"sam:{folder / 'sam'}" if source == "sam" else source
    # The pre-pass would weigh pixels too.
    binary = {"pao.variant": "binary", "prepass.enabled": False}
    found = weights(training, **binary, **{"pao.hand": hand})
    settings = read_settings({**FIT, **binary})
    fit = make_fit(training, settings, 0, torch.device("cpu"))
    masks = hand_masks(fit.data, hand, torch.device("cpu"))
    assert torch.equal(found, (masks[:3] > 127).float())
    assert not torch.equal(masks, fit.data.frames.masks)
    if source == "graph-cut":  # the painted hand is where its parameters say, and alone
        shared = ((masks > 127) & (fit.data.frames.masks > 127)).sum()
        assert shared / ((masks > 127) | (fit.data.frames.masks > 127)).sum() > 0.8


def test_without_pao_no_checkpoint_is_opened(make_training: TrainingMaker) -> None:
    missing = {"pao.regions": "sam:/none", "pao.hand": "sam:/none", "pao.enabled": False}
    weights(make_training(), **missing)
    settings = read_settings(missing)
    assert (settings.pao.regions, settings.pao.hand) == ("superpixels", "estimated")


@pytest.mark.parametrize("hands", ["right", "both"])
def test_roots_are_the_wrists_in_the_image(hands: str, make_training: TrainingMaker) -> None:
    training = make_training(hands)
    roots = hand_roots(training, training.train)
    assert roots.shape == (len(training.train), len(training.sides), 2)
    # The wrist lies before the camera, within the image or a hand's length from it.
    assert (np.abs(roots - training.width / 2) < training.width).all()


@pytest.fixture
def few_frames(make_painted: Callable[..., Capture], tmp_path: Path) -> list[str]:
    """Words that choose the painted capture, and six of its frames for training."""
    capture = make_painted()
    splits = split_file(tmp_path / "splits.json", capture.info.id, [0, 6], FRAMES)
    return ["--capture", str(capture.root), "--splits", splits]


def with_every_network(folder: Path, regions: str, hand: str) -> dict[str, Any]:
    """Settings of the mode `paper` with each of its networks from a file."""
    return {
        **FIT,
        "mode": "paper",
        "schedule.epochs": 0,
        "pao.regions": f"sam:{folder / regions}",
        "pao.hand": f"sam:{folder / hand}",
        "perceptual": f"vgg19:{folder / 'vgg19.pth'}",
    }


@pytest.mark.usefixtures("_fewer_points")
def test_a_fit_from_the_command_line_with_every_network(
    folder: Path, make_painted: Callable[..., Capture], tmp_path: Path, capsys: Any
) -> None:
    settings = with_every_network(folder, "sam", "sam.pth")
    out = tmp_path / "avatar"
    command = ["fit", str(make_painted().root), "-o", str(out)]
    assert wildghand([*command, *options(settings)]) == 0
    avatar = load_avatar(out)
    assert avatar.model.finite()
    assert avatar.settings.perceptual == settings["perceptual"]
    assert avatar.settings.pao.regions == settings["pao.regions"]
    refused = [*command[:-1], str(tmp_path / "b"), *options({**FIT, "perceptual": "vgg19:/none"})]
    assert wildghand([*refused, "--set", "terms.perceptual=0.001"]) != 0
    assert "/none: does not exist" in capsys.readouterr().err


def test_an_evaluation_in_the_sandbox_sees_the_files(
    folder: Path,
    make_painted: Callable[..., Capture],
    few_frames: list[str],
    tmp_path: Path,
    capsys: Any,
) -> None:
    settings = with_every_network(folder, "sam.pth", "sam")
    out = tmp_path / "runs"
    command = [*few_frames, "-o", str(out), *options(settings)]
    assert hwp_bench(["evaluate", "wildghand", *command]) == 0, capsys.readouterr().err
    result = json.loads((out / "results.json").read_text())["captures"][0]
    assert result["failure"] is None
    assert result["steps"] == 3
    # The same files are the same evaluation, other weights another one.
    assert hwp_bench(["evaluate", "wildghand", *command]) == 0
    again = json.loads((out / "results.json").read_text())["captures"][0]
    assert again == result
    manifest = read_manifest(find_method("wildghand"))
    captures = open_captures([make_painted().root])

    def key() -> str:
        values = {"pao.regions": settings["pao.regions"]}
        chosen = EvaluationSettings(run=RunSettings(values))
        plan = make_plan(manifest, captures, with_setting_files(manifest, chosen), {})
        return plan.evaluations[0].key

    before = key()
    write_sam_file(folder / "sam.pth", seed=1)
    assert key() != before
    write_sam_file(folder / "sam.pth")


def test_an_ablation_takes_the_networks_too(
    folder: Path, few_frames: list[str], tmp_path: Path, capsys: Any
) -> None:
    settings = {**FIT, "pao.hand": f"sam:{folder / 'sam.pth'}"}
    command = ["ablate", "--with", "binary-mask", "--seeds", "1", "-o", str(tmp_path / "runs")]
    command += [*few_frames, *options(settings)]
    assert hwp_bench(command) == 0, capsys.readouterr().err


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"pao.regions": "sam:/none/sam.pth"}, "does not exist"),
        ({"pao.hand": "sam:VGG"}, "not a checkpoint of Segment Anything"),
        ({"perceptual": "vgg19:SAM", "terms.perceptual": 0.1}, "torchvision's VGG-19"),
        ({"perceptual": "vgg19:TEXT", "terms.perceptual": 0.1}, "cannot be read"),
        ({"pao.regions": "slic"}, "superpixels or sam:PATH"),
        ({"pao.hand": "mask"}, "estimated or graph-cut or sam:PATH"),
        ({"perceptual": "vgg16:x"}, "filter-bank or vgg19:PATH"),
        ({"prior": "NONE"}, "NONE: prior: is not a prior"),
        ({"prior": "/none"}, "/none: prior: is not a prior"),
    ],
    ids=str,
)
def test_what_cannot_work_is_refused_before_a_suite_is_rendered(
    settings: dict[str, Any], problem: str, folder: Path, tmp_path: Path, capsys: Any
) -> None:
    (tmp_path / "text").write_text("no weights")
    places = {"VGG": folder / "vgg19.pth", "SAM": folder / "sam.pth", "TEXT": tmp_path / "text"}
    for word, place in places.items():
        settings = {
            name: value.replace(word, str(place)) if isinstance(value, str) else value
            for name, value in settings.items()
        }
    with pytest.raises((BadInput, UsageError), match=problem):
        WildGHandMethod({"device": "cpu", **settings})
    if "PATH" not in problem:
        out = tmp_path / "runs"
        for command in ("evaluate", "ablate"):
            words = [command, "wildghand", "--suite", "full", "-o", str(out), *options(settings)]
            assert hwp_bench(words) != 0
            assert problem in capsys.readouterr().err
        assert not out.exists()


def test_a_network_for_a_term_of_weight_0_is_refused_before_anything_is_read(
    folder: Path, tmp_path: Path
) -> None:
    settings = {"device": "cpu", "perceptual": f"vgg19:{folder / 'vgg19.pth'}"}
    with pytest.raises(UsageError, match=r"terms\.perceptual is 0"):
        WildGHandMethod(settings)
    with pytest.raises(UsageError, match=r"terms\.perceptual is 0"):
        fit_capture(tmp_path / "none", tmp_path / "avatar", settings=settings)


@pytest.mark.parametrize(
    "settings",
    [
        {"pao.regions": "sam:PLACE/weights"},
        {"pao.hand": "sam:PLACE"},
        {"perceptual": "vgg19:PLACE/weights"},
        {"prior": "PLACE"},
    ],
    ids=lambda settings: next(iter(settings)),
)
def test_a_file_of_another_content_under_the_same_name_is_noticed(
    settings: dict[str, str], make_painted: Callable[..., Capture], tmp_path: Path
) -> None:
    capture, place = make_painted(), tmp_path / "place"
    place.mkdir()
    (place / DESCRIPTION).write_text("{}")
    named = {name: value.replace("PLACE", str(place)) for name, value in settings.items()}
    job = VideoJob(tmp_path / "hand.mp4", tmp_path / "hand", VideoFit(settings=named))
    job.capture = capture.root
    request = tmp_path / "request"
    request.mkdir()
    (request / REQUEST).write_text("{}")

    def told() -> list[object]:
        chosen = read_settings(named)
        saved = digest_of_request(request, capture, chosen)
        return [digest_of_named_files(chosen), FitStage().facts(job), saved]

    (place / "weights").write_bytes(b"one")
    first, again = told(), told()
    (place / "weights").write_bytes(b"another")
    assert first == again
    assert all(one != other for one, other in zip(first, told(), strict=True))


def test_a_finished_avatar_of_another_checkpoint_is_not_taken(
    folder: Path, make_painted: Callable[..., Capture], tmp_path: Path
) -> None:
    weights = Path(shutil.copy(folder / "vgg19.pth", tmp_path / "vgg19.pth"))
    settings = {**FIT, "terms.perceptual": 0.001, "perceptual": f"vgg19:{weights}"}

    def fitted() -> WildGHandAvatar:
        source, budget = make_painted().root, Budget(steps=1)
        return fit_capture(source, tmp_path / "avatar", settings=settings, budget=budget)

    made = fitted().model.snapshot()
    assert all(torch.equal(value, made[name]) for name, value in fitted().model.snapshot().items())
    weights.write_bytes(weights.read_bytes() + b"0")
    with pytest.raises(UsageError, match="exists"):
        fitted()
