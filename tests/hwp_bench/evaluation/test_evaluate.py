"""Evaluation end to end. Oracles: the truth submitted as an entry, black images, arithmetic."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_captures import CaptureMaker
from small_methods import write_submission

import hwp_bench
from hwp_bench.base.errors import BadCapture, BadImage, BadSplit, MethodFailed, UsageError
from hwp_bench.base.images import write_image
from hwp_bench.capture import Capture, CaptureWriter
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.cli.main import main
from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
from hwp_bench.evaluation.evaluate import default_folder, evaluate, make_budget
from hwp_bench.methods.contract import Budget, RunSettings
from hwp_bench.metrics import METRICS, metric, penalty
from hwp_bench.metrics.score import score_frame
from hwp_bench.results import Results, read_results
from hwp_bench.run.sandbox.confinement import Confinement

# Some methods here note their fits next to their folder, which a sandbox forbids.
SETTINGS = EvaluationSettings(confinement=Confinement("none"))


def submission(folder: Path, captures: list[Capture], pixels=Capture.frame) -> Path:
    """An entry that is nothing but predictions; `pixels(capture, frame)` makes them."""
    return write_submission(
        folder,
        {
            f"{capture.info.id}/{frame:06d}.png": pixels(capture, frame)
            for capture in captures
            for frame in contiguous_split(capture.info.id, len(capture)).test.tolist()
        },
    )


def run(entry: Path, captures: list[Capture], out: Path) -> Results:
    return evaluate(str(entry), [capture.root for capture in captures], out, SETTINGS)


def scores(results: Results) -> list[dict[str, float]]:
    return [frame.scores for capture in results.captures for frame in capture.frames]


@pytest.fixture
def captures(make_capture: CaptureMaker) -> list[Capture]:
    return [
        make_capture("single", frames=20, size=48, truth=True),
        make_capture("pair", frames=20, size=48, hands="both"),
    ]


def test_the_command_prints_scores_by_perturbation(captures, tmp_path: Path, capsys) -> None:
    # The small captures have motion blur and nothing else.
    entry = submission(tmp_path / "entry", captures)
    words = ["evaluate", str(entry), "--capture", *(str(one.root) for one in captures)]
    assert main([*words, "-o", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr().out
    places = [shown.index(text) for text in ("All captures", "Per perturbation", "Per capture")]
    assert places == sorted(places)
    assert "Motion Blur" in shown[places[1] : places[2]]
    assert "Illumination" not in shown


def test_the_ground_truth_scores_perfectly_in_every_metric(captures, tmp_path: Path) -> None:
    results = run(submission(tmp_path / "entry", captures), captures, tmp_path / "out")
    rows = scores(results)
    assert len(rows) == 4
    weight_free = {facts.name for facts in METRICS if facts.needs is None}
    for row in rows:
        assert weight_free <= set(row)
        for name, value in row.items():
            assert value == pytest.approx(metric(name).perfect, abs=1e-9), name
    assert [capture.exact_masks for capture in results.captures] == [True, False]
    assert read_results(tmp_path / "out") == results
    for name in ("worst", "median", "best", "comparison"):
        assert (tmp_path / "out" / "captures" / "pair" / "pictures" / f"{name}.png").is_file()


def test_black_images_score_what_arithmetic_says(captures, tmp_path: Path) -> None:
    entry = submission(
        tmp_path / "entry", captures, lambda capture, frame: np.zeros((48, 48, 3), np.uint8)
    )
    results = run(entry, captures, tmp_path / "out")
    capture = captures[0]
    for frame in results.captures[0].frames:
        hand = capture.true_mask(frame.frame) == 255
        error = ((capture.frame(frame.frame)[hand] / 255.0) ** 2).mean()
        assert frame.scores["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-9)
        share = hand.mean()
        assert frame.scores["psnr_full"] == pytest.approx(-10 * np.log10(error * share), abs=1e-9)
        assert frame.scores["ssim"] < 0.1


def noisy(capture: Capture, frame: int) -> np.ndarray:
    rng = np.random.default_rng(frame)
    return np.clip(capture.frame(frame) + rng.normal(0, 20, (48, 48, 3)), 0, 255).astype(np.uint8)


def test_what_does_not_count_changes_nothing(captures, tmp_path: Path) -> None:
    """Order, further files, an alpha channel, and pixels outside of the mask."""
    plain = run(submission(tmp_path / "a", captures, noisy), captures, tmp_path / "out-a")

    def painted(capture: Capture, frame: int) -> np.ndarray:
        mask, _ = capture.scoring_mask(frame)
        pixels = np.where(mask[:, :, None] > 127, noisy(capture, frame), 255)
        return np.dstack([pixels, np.zeros((48, 48, 1))]).astype(np.uint8)

    other = run(submission(tmp_path / "b", captures, painted), captures, tmp_path / "out-b")
    assert scores(other) == scores(plain)
    entry = submission(tmp_path / "c", captures, noisy)
    folder = entry / "predictions" / "single"
    # Written again in the opposite order, with masks, other frames and files next to them.
    contents = [(path, path.read_bytes()) for path in sorted(folder.iterdir(), reverse=True)]
    shutil.rmtree(folder)
    (folder / "masks").mkdir(parents=True)
    for path, content in contents:
        path.write_bytes(content)
        write_image(folder / "masks" / path.name, np.zeros((48, 48), np.uint8))
        write_image(folder / f"{path.stem}_mask.png", np.zeros((48, 48), np.uint8))
    write_image(folder / "000001.png", np.zeros((48, 48, 3), np.uint8))
    (folder / "notes.txt").write_text("hello")
    (entry / "masks").mkdir()
    other = run(entry, captures, tmp_path / "out-c")
    assert scores(other) == scores(plain)
    assert other.captures[0].predictions_digest == plain.captures[0].predictions_digest


def test_a_frame_that_cannot_be_scored_is_named_and_penalised(captures, tmp_path: Path) -> None:
    entry = submission(tmp_path / "entry", captures)
    damages = {
        "000018.png: does not exist": Path.unlink,
        "000018.png: is empty": lambda path: path.write_bytes(b""),
        "is 48x47 pixels where 48x48": lambda path: write_image(
            path, np.zeros((47, 48, 3), np.uint8)
        ),
        "is damaged or truncated": lambda path: path.write_bytes(path.read_bytes()[:200]),
    }
    picture = entry / "predictions" / "single" / "000018.png"
    for number, (problem, damage) in enumerate(damages.items()):
        picture.unlink(missing_ok=True)
        write_image(picture, captures[0].frame(18))
        damage(picture)
        results = run(entry, captures, tmp_path / f"out-{number}")
        bad, good = results.captures[0].frames
        assert problem in bad.failure
        assert bad.scores == {name: penalty()[name] for name in bad.scores}
        assert good.failure is None
        assert good.scores["psnr"] == metric("psnr").perfect
        assert results.captures[0].failed_frames == 1
    # A capture without predictions fails by name, and the rest is scored.
    shutil.rmtree(entry / "predictions" / "single")
    results = run(entry, captures, tmp_path / "out")
    assert "has no predictions for single" in results.captures[0].failure
    assert [capture.failed_frames for capture in results.captures] == [2, 0]


def counting_method(folder: Path, body: str = "") -> Path:
    """A method that paints gray and notes each fit in a file next to its folder."""
    folder.mkdir()
    (folder / "counting_method.py").write_text(
        f"""
import pathlib
import numpy as np
class Method:
    steps = 4
    def __init__(self, settings, seed): self.level = settings.get("level", 0.5)
    def fit(self, training, budget, report):
        {body or "pass"}
        with open({str(folder.parent / "fits.log")!r}, "a") as stream:
            stream.write(training.id + " ")
        return self
    def render(self, hands, camera):
        return np.full((camera.height, camera.width, 4), self.level)
"""
    )
    (folder / "method.toml").write_text(
        'schema = "hwp-method/1"\ntraining = "none"\n'
        'name = "count"\n[entry]\npython = "counting_method:Method"\n'
        "[presets.default]\nlevel = 0.5\n"
    )
    return folder


def test_a_second_start_takes_what_is_finished_and_redoes_what_changed(
    captures, tmp_path: Path
) -> None:
    method, out = counting_method(tmp_path / "method"), tmp_path / "out"
    fits = method.parent / "fits.log"
    first = run(method, captures[:1], out)
    second = run(method, captures, out)
    assert fits.read_text() == "single pair "
    assert second.captures[0] == first.captures[0]
    assert first.captures[0].steps == 4
    assert first.captures[0].curve[-1].scores["psnr"] > 0
    changed = replace(SETTINGS, run=RunSettings({"level": 0.25}))
    with pytest.raises(UsageError, match=r"setting level 0\.5, now 0\.25.*--overwrite"):
        evaluate(str(method), [captures[0].root], out, changed)
    third = evaluate(str(method), [captures[0].root], out, changed, overwrite=True)
    assert fits.read_text() == "single pair single "
    assert scores(third) != scores(first)


def test_a_crash_on_one_capture_loses_nothing_and_is_tried_again(captures, tmp_path) -> None:
    body = "if training.id == 'single': raise RuntimeError('no luck')"
    method, out = counting_method(tmp_path / "method", body), tmp_path / "out"
    results = run(method, captures, out)
    assert "RuntimeError: no luck" in results.captures[0].failure
    assert results.captures[1].failed_frames == 0
    # The process of the failed one took its time too.
    assert results.captures[0].wall_seconds > 0.05
    assert "RuntimeError: no luck" in (out / "captures" / "single" / "log.txt").read_text()
    # The folder of the run is gone; the text must not lead there.
    assert "/run/" not in results.captures[0].failure
    assert "log.txt next to result.json" in results.captures[0].failure
    run(method, captures, out)
    assert (method.parent / "fits.log").read_text() == "pair "


def test_a_fit_of_an_hour_is_not_killed_after_an_hour(
    captures, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    limits: list[float] = []

    def stop(*given: object, time_limit: float, **more: object) -> None:
        limits.append(time_limit)
        raise MethodFailed("stopped")

    monkeypatch.setattr("hwp_bench.evaluation.capture_evaluation.run_method", stop)
    method, root = counting_method(tmp_path / "method"), captures[0].root
    hwp_bench.evaluate(method, root, tmp_path / "out", seconds=3600.0)
    assert limits == [7200.0]
    words = ["evaluate", str(method), "--capture", str(root), "-o", str(tmp_path / "other")]
    assert main([*words, "--budget", "60", "--time-limit", "60"]) == 2
    assert "--time-limit: 60 s end a fit of 60 s" in capsys.readouterr().err


def test_faults_of_the_capture_are_errors_before_the_method_runs(
    captures, make_capture: CaptureMaker, tmp_path: Path
) -> None:
    method = counting_method(tmp_path / "method")
    single, pair = captures
    with pytest.raises(BadCapture, match="another capture has the id 'single' too"):
        run(method, [single, single], tmp_path / "out")
    short = make_capture("short", frames=2, perturbations={})
    with pytest.raises(BadSplit, match="has 2 frames, too few"):
        run(method, [short], tmp_path / "out")
    for frame, problem in ((19, "mask of test frame 19 leaves"), (18, "test frames 18, 19 leave")):
        write_image(pair.root / "masks" / f"{frame:06d}.png", np.zeros((48, 48), np.uint8))
        with pytest.raises(BadCapture, match=problem):
            run(method, [pair], tmp_path / "out")
    (single.root / "frames" / "000018.png").write_bytes(b"")
    with pytest.raises(BadImage, match=r"000018\.png: is empty"):
        run(method, [single], tmp_path / "out")
    assert not (method.parent / "fits.log").exists()


def test_a_validation_frame_without_a_hand_is_left_out_of_the_curve(
    make_capture: CaptureMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Oracle: the score of the other validation frame, which the method's gray has.
    write, empty = CaptureWriter.mask, {17}

    def blank(writer: CaptureWriter, frame: int, mask: np.ndarray) -> None:
        write(writer, frame, mask * (frame not in empty))

    monkeypatch.setattr(CaptureWriter, "mask", blank)
    method, one = counting_method(tmp_path / "method"), make_capture("one", frames=20, size=48)
    empty |= {16}
    none = make_capture("none", frames=20, size=48)
    found, lost = run(method, [one, none], tmp_path / "out").captures
    assert (found.failure, lost.failure) == (None, None)
    gray = np.full((48, 48, 3), 0.5)
    assert found.curve[-1].scores == score_frame(gray, one.frame(16), one.mask(16))
    assert lost.curve == []


@pytest.mark.parametrize(
    ("method", "suite", "frames", "expected"),
    [
        ("baselines/plain/", "mini", "perturbed", "runs/plain-mini"),
        ("plain", "smoke", "clean", "runs/plain-smoke-clean"),
        ("my/method", "captures", "unperturbed-only", "runs/method-captures-unperturbed-only"),
    ],
)
def test_an_oracle_has_a_results_folder_of_its_own(
    method: str, suite: str, frames: str, expected: str
) -> None:
    settings = EvaluationSettings(suite=suite, run=RunSettings(frames=frames))
    assert default_folder(method, settings) == Path(expected)


def test_budgets_and_seeds_have_results_folders_of_their_own() -> None:
    run = RunSettings({}, 1, Budget(16.0, 300))
    folder = default_folder("plain", EvaluationSettings("mini", run=run))
    assert folder == Path("runs/plain-mini-16s-300steps-seed1")
    run = RunSettings({}, 0, make_budget(16.0, None))
    folder = default_folder("plain", EvaluationSettings("mini", run=run))
    assert folder == Path("runs/plain-mini-16s")
