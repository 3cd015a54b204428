"""The free-view clip in an evaluation. Oracles: its truth as an entry, penalties, tampering."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_captures import CaptureMaker
from small_methods import write_manifest, write_submission

from hwp_bench.base.errors import BadCapture, BadInput
from hwp_bench.base.images import read_rgb, write_image
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.check import check_capture
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.cli.main import main
from hwp_bench.commitments import open_sealed, publish
from hwp_bench.evaluation.capture_evaluation import CaptureEvaluation, EvaluationSettings
from hwp_bench.evaluation.evaluate import evaluate
from hwp_bench.methods.contract import RunSettings
from hwp_bench.methods.manifest import read_manifest
from hwp_bench.methods.request import open_request, write_request
from hwp_bench.metrics import metric, penalty
from hwp_bench.results import CaptureResult, read_results
from hwp_bench.run.sandbox.confinement import Confinement

SIZE, VIEWS = 32, 5
OPEN = EvaluationSettings(confinement=Confinement("none"))


@pytest.fixture
def bare(make_capture: CaptureMaker, tmp_path: Path) -> Capture:
    return make_capture("tiny", size=SIZE, truth=True, folder=tmp_path / "bare")


@pytest.fixture
def capture(bare: Capture, make_capture: CaptureMaker, tmp_path: Path) -> Capture:
    root = tmp_path / "with" / "tiny"
    shutil.copytree(bare.root, root)
    make_capture("free", frames=VIEWS, size=SIZE, truth=True, perturbations={}, folder=root)
    return open_capture(root)


def clip_of(capture: Capture) -> Capture:
    clip = capture.free_view
    assert clip is not None
    return clip


def submission(folder: Path, capture: Capture, views: range | tuple[int, ...]) -> Path:
    """The truth as an entry, with some frames of the clip."""
    frames = contiguous_split(capture.info.id, len(capture)).test.tolist()
    images = {f"tiny/{frame:06d}.png": capture.frame(frame) for frame in frames}
    images |= {f"tiny/free/{frame:06d}.png": clip_of(capture).frame(frame) for frame in views}
    return write_submission(folder, images)


def method(folder: Path, *, fit: str = "pass", render: str = "pass") -> Path:
    """A method in Python that paints grey."""
    folder.mkdir()
    (folder / "free_method.py").write_text(
        f"""
import pathlib
import numpy as np
class Method:
    def __init__(self, settings, seed): self.drawn = 0
    def fit(self, training, budget, report):
        {fit}
        return self
    def render(self, hands, camera):
        self.drawn += 1
        pixels = np.full((camera.height, camera.width, 4), 0.5)
        {render}
        return pixels
"""
    )
    write_manifest(folder, "grey", 'python = "free_method:Method"')
    return folder


def run(entry: Path, capture: Capture, out: Path, how: EvaluationSettings = OPEN) -> CaptureResult:
    (result,) = evaluate(str(entry), [capture.root], out, how).captures
    assert read_results(out).captures == [result]
    return result


def test_who_offers_no_clip_is_not_penalised_for_it_where_it_fails(
    capture: Capture, tmp_path: Path
) -> None:
    entry = write_submission(tmp_path / "entry", {"other/000018.png": capture.frame(18)})
    result = run(entry, capture, tmp_path / "out")
    assert "has no predictions" in (result.failure or "")
    assert result.free_view is None


def test_the_truth_scores_perfectly_and_a_missing_frame_costs_its_penalty(
    capture: Capture, tmp_path: Path
) -> None:
    entry = submission(tmp_path / "entry", capture, (0, 1, 3, 4))
    result = run(entry, capture, tmp_path / "out")
    free = result.free_view
    assert free is not None
    assert free.digest == clip_of(capture).digest
    assert [row.frame for row in free.frames] == list(range(VIEWS))
    for row in free.frames:
        if row.frame == 2:
            assert "does not exist" in (row.failure or "")
            assert row.scores == penalty()
            continue
        assert row.failure is None
        for name, value in row.scores.items():
            assert value == pytest.approx(metric(name).perfect, abs=1e-9), name
    # Scored apart: the test frames know nothing of it.
    assert [row.frame for row in result.frames] == [18, 19]
    assert result.failed_frames == 0
    folder = tmp_path / "out" / "captures" / "tiny"
    assert sorted(path.stem for path in (folder / "free").iterdir()) == [
        f"{frame:06d}" for frame in (0, 1, 3, 4)
    ]
    picture = read_rgb(folder / "pictures" / "free_view.png")
    assert picture.std() > 10.0


def test_what_does_not_offer_the_clip_is_scored_as_before(
    capture: Capture, bare: Capture, tmp_path: Path
) -> None:
    entry = submission(tmp_path / "entry", capture, ())
    result = run(entry, capture, tmp_path / "out")
    assert result.free_view is None
    assert result.frames == run(entry, bare, tmp_path / "bare-out").frames


def test_a_method_that_knows_nothing_of_it_needs_no_change(
    capture: Capture, bare: Capture, tmp_path: Path
) -> None:
    grey = method(tmp_path / "grey")
    result, before = (
        run(grey, item, tmp_path / name) for item, name in ((capture, "a"), (bare, "b"))
    )
    assert before.free_view is None
    assert result.digest == before.digest
    assert result.frames == before.frames
    assert result.key != before.key
    free = result.free_view
    assert free is not None
    assert [row.failure for row in free.frames] == [None] * VIEWS
    # Oracle: arithmetic; grey is level 127 or 128.
    clip = clip_of(capture)
    for row in free.frames:
        hand = clip.true_mask(row.frame) == 255
        error = ((clip.frame(row.frame)[hand] / 255.0 - 128 / 255.0) ** 2).mean()
        assert row.scores["psnr"] == pytest.approx(-10.0 * np.log10(error), abs=0.1)


@pytest.mark.parametrize(
    "fault",
    [
        "if self.drawn > 7: raise RuntimeError('no luck')",
        "if self.drawn > 7: pixels[0, 0] = np.inf",
    ],
)
def test_a_frame_that_fails_costs_itself_and_no_more(
    capture: Capture, tmp_path: Path, fault: str
) -> None:
    # Drawn first: two frames of the last checkpoint and two test frames; then the clip.
    result = run(method(tmp_path / "m", render=fault), capture, tmp_path / "out")
    assert (result.failure, result.failed_frames) == (None, 0)
    free = result.free_view
    assert free is not None
    assert [row.failure is None for row in free.frames] == [True] * 3 + [False] * 2
    assert free.frames[4].scores == penalty()


def test_a_clip_that_fails_is_said_and_gives_status_1(
    capture: Capture, tmp_path: Path, capsys
) -> None:
    failing = method(tmp_path / "m", render="if self.drawn > 7: raise RuntimeError('no luck')")
    words = ["evaluate", str(failing), "--capture", str(capture.root), "-o", str(tmp_path / "out")]
    assert main(words) == 1
    told = capsys.readouterr().err
    assert "tiny, free view: 2 of 5 frames" in told
    assert "log: " in told


def test_a_method_that_crashes_gets_every_penalty(capture: Capture, tmp_path: Path) -> None:
    crashing = method(tmp_path / "m", fit="raise RuntimeError('no luck')")
    free = run(crashing, capture, tmp_path / "out").free_view
    assert free is not None
    assert all(row.scores == penalty() for row in free.frames)


def test_a_request_has_hands_and_cameras_but_no_picture(capture: Capture, tmp_path: Path) -> None:
    clip, split = clip_of(capture), contiguous_split("tiny", 20)
    root = write_request(tmp_path / "request", capture, split, RunSettings({}))
    assert sorted(path.name for path in (root / "free").rglob("*")) == ["cameras.npz", "hands.npz"]
    views = open_request(root).free_views
    assert views is not None
    assert len(views) == VIEWS
    np.testing.assert_array_equal(views.hands["right"].pose, clip.hands["right"].pose)
    np.testing.assert_array_equal(views.hand_poses(2)["right"].betas, clip.hands["right"].betas)
    np.testing.assert_array_equal(views.cameras.viewmats, clip.cameras.viewmats)


def test_true_betas_are_given_where_the_training_frames_have_them(
    capture: Capture, tmp_path: Path
) -> None:
    clip, split = clip_of(capture), contiguous_split("tiny", 20)
    truth = {side: replace(hand, betas=hand.betas + 1.0) for side, hand in clip.hands.items()}
    clip.__dict__["true_hands"] = truth
    given = {}
    for choice in ("perturbed", "true:poses", "true:poses,betas"):
        root = write_request(tmp_path / "r", capture, split, RunSettings({}, frames=choice))
        views = open_request(root).free_views
        assert views is not None
        given[choice] = views.hands["right"].betas - clip.hands["right"].betas
    assert [float(np.round(value.mean(), 6)) for value in given.values()] == [0.0, 0.0, 1.0]


def test_the_pictures_cannot_be_read_from_inside(capture: Capture, tmp_path: Path) -> None:
    place = str(capture.root / "free")
    look = f"print('seen:', pathlib.Path({place!r}).exists(), flush=True)"
    how = EvaluationSettings(confinement=Confinement("auto"))
    result = run(method(tmp_path / "m", fit=look), capture, tmp_path / "out", how)
    if result.isolation != "namespaces":
        pytest.skip("no user namespaces on this machine")
    log = (tmp_path / "out" / "captures" / "tiny" / "log.txt").read_text()
    assert "seen: False" in log


def test_the_key_follows_the_clip(
    capture: Capture, bare: Capture, make_capture: CaptureMaker, tmp_path: Path
) -> None:
    manifest = read_manifest(method(tmp_path / "m"))
    split = contiguous_split("tiny", 20)

    def key(item: Capture) -> str:
        return CaptureEvaluation(manifest, item, split, EvaluationSettings()).key

    first = key(capture)
    shutil.rmtree(capture.root / "free")
    assert key(open_capture(capture.root)) == key(bare)
    make_capture("free", frames=VIEWS - 1, size=SIZE, truth=True, folder=capture.root)
    assert len({first, key(bare), key(open_capture(capture.root))}) == 3


@pytest.fixture
def evaluated(capture: Capture, tmp_path: Path) -> Path:
    run(submission(tmp_path / "entry", capture, range(VIEWS)), capture, tmp_path / "out")
    return tmp_path / "out"


def verify(out: Path, capture: Capture, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict]:
    capsys.readouterr()
    status = main(["verify", str(out), "--capture", str(capture.root), "--json"])
    return status, json.loads(capsys.readouterr().out)[0]


def test_an_untouched_clip_holds(evaluated: Path, capture: Capture, capsys) -> None:
    status, found = verify(evaluated, capture, capsys)
    assert (status, found["discrepancies"]) == (0, [])
    assert found["frames"] == 2 + VIEWS


def _edit(out: Path, change: Callable[[dict], object]) -> None:
    file = out / "results.json"
    value = json.loads(file.read_text())
    change(value["captures"][0])
    file.write_text(json.dumps(value))


def test_an_edited_number_is_found_out(evaluated: Path, capture: Capture, capsys) -> None:
    before = (evaluated / "results.json").read_bytes()
    changes: dict[str, Callable[[dict], object]] = {
        "frame 1, psnr": lambda free: free["frames"][1]["scores"].update(psnr=1.0),
        "capture": lambda free: free.update(digest="0" * 64),
        "predictions": lambda free: free.update(predictions_digest="0" * 64),
        "frames": lambda free: free["frames"].pop(),
    }
    for what, change in changes.items():
        (evaluated / "results.json").write_bytes(before)
        _edit(evaluated, lambda value, change=change: change(value["free_view"]))
        status, found = verify(evaluated, capture, capsys)
        assert status == 1
        names = {(item["capture"], item["what"]) for item in found["discrepancies"]}
        assert ("tiny, free view", what) in names


def test_edited_pictures_are_found_out(evaluated: Path, capture: Capture, capsys) -> None:
    black = np.zeros((SIZE, SIZE, 3), np.uint8)
    kept = evaluated / "captures" / "tiny" / "free" / "000001.png"
    truth = kept.read_bytes()
    write_image(kept, black)
    status, found = verify(evaluated, capture, capsys)
    assert status == 1
    assert any(item["what"] == "predictions" for item in found["discrepancies"])
    kept.write_bytes(truth)
    write_image(capture.root / "free" / "frames" / "000001.png", black)
    assert not check_capture(capture.root).ok
    assert verify(evaluated, capture, capsys)[0] == 1


def test_a_publication_seals_the_pictures(capture: Capture, tmp_path: Path) -> None:
    publication = publish([capture.root], tmp_path / "publication", salt="5a" * 32)
    public = publication.public / "tiny"
    assert sorted(path.name for path in (public / "free").rglob("*")) == [
        "cameras.npz",
        "hands.npz",
    ]
    part = open_sealed(publication.sealed)
    sealed = open_capture(part.captures[0])
    assert clip_of(sealed).digest == clip_of(capture).digest
    entry = submission(tmp_path / "entry", capture, range(VIEWS))
    free = run(entry, sealed, tmp_path / "out").free_view
    assert free is not None
    assert free.frames[0].scores["psnr"] == metric("psnr").perfect
    picture = publication.sealed / "tiny" / "free" / "frames" / "000003.png"
    write_image(picture, np.zeros((SIZE, SIZE, 3), np.uint8))
    with pytest.raises(BadInput, match="committed"):
        open_sealed(publication.sealed)


def test_a_clip_without_a_hand_is_named_before_the_method_runs(
    capture: Capture, tmp_path: Path
) -> None:
    write_image(
        capture.root / "free" / "truth" / "masks" / "000002.png", np.zeros((SIZE, SIZE), np.uint8)
    )
    with pytest.raises(BadCapture, match="leaves no pixel"):
        run(method(tmp_path / "m", fit="1 / 0"), capture, tmp_path / "out")


def test_a_clip_whose_scores_were_taken_out_is_found_out(
    evaluated: Path, capture: Capture, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: the predictions of the clip that are still there."""
    _edit(evaluated, lambda value: value.update(free_view=None))
    status, found = verify(evaluated, capture, capsys)
    assert status == 1
    assert "tiny, free view" in {item["capture"] for item in found["discrepancies"]}
