"""From a video to an avatar at toy size: made, kept, killed and continued, and in one line refused.

Oracles: the synthetic clip's own landmarks, the run that was never stopped, and decoders.
"""

from __future__ import annotations

import functools
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from encoded_video import HLG, hlg_frame, write_samples
from synthetic_clip import landmark_import, make_clip, write_landmarks, write_video
from two_hand_clip import make_two_hands, write_two_hands

import wildghand
from hwp_bench.base.errors import BadInput, MissingDependency, UsageError
from hwp_bench.base.images import read_rgb
from hwp_bench.capture import open_capture
from hwp_bench.importers.shared.landmarks import read_hand_tracks, read_sides, write_hand_tracks
from hwp_bench.tracking.networks import HAND, PALM, HandModels, models_folder
from hwp_bench.tracking.track_video import NoHandSeen
from wildghand.avatar.files import CALL, load_avatar
from wildghand.cli.main import main
from wildghand.from_video import VideoFit, make, make_avatar, stages
from wildghand.from_video.run import QUICK as QUICK_CHANGES
from wildghand.from_video.run import QUICK_FRAMES, VideoJob, stride, with_quick
from wildghand.from_video.run import VIDEO as VIDEO_CHANGES
from wildghand.from_video.stages import STAGES, Place, TrackStage, import_options
from wildghand.model.settings import read_settings

pytestmark = pytest.mark.slow

COUNT, STEPS = 16, 6
NAMES = [stage.name for stage in STAGES]
#: A fit without what no stage here asks about: bending and shadows are a third of a run's time.
SETTINGS: dict[str, Any] = {
    "gaussians": 600,
    "device": "cpu",
    "schedule.batch": 1,
    "schedule.steps": STEPS,
    "subject.enabled": False,
    "shadows.enabled": False,
}
#: An import that is only as good as the perfect landmarks of the clip.
IMPORT = landmark_import(30, outline_steps=3)
#: Edge, px, and frames of the turntables: one of full size is most of a run's time.
SMALL = 96, 12
CLIP = Path(__file__).resolve().parents[4] / "shared" / "data" / "real_hand"


def choices(folder: Path, **changes: Any) -> VideoFit:
    given: dict[str, Any] = {
        "landmarks": folder / "hand.npz",
        "importer": IMPORT,
        "settings": SETTINGS,
    }
    return VideoFit(**{**given, **changes})


@pytest.fixture(scope="module", autouse=True)
def small_turntable() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in zip(("SIZE", "FRAMES"), SMALL, strict=True):
            patch.setattr(stages, name, value)
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a video, its landmarks, and the avatar that was made of them."""
    folder = tmp_path_factory.mktemp("made")
    clip = make_clip(COUNT)
    write_video(folder / "hand.avi", [clip.picture(frame) for frame in range(COUNT)])
    write_landmarks(folder / "hand.npz", clip.landmarks)
    result = make_avatar(folder / "hand.avi", folder / "my_hand", choices(folder))
    assert result.kept == ()
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    """A copy of it; the record has no paths."""
    shutil.copytree(made, tmp_path / "copy")
    return tmp_path / "copy"


def tensors(path: Path) -> dict[str, torch.Tensor]:
    return load_avatar(path).model.state_dict()


def same(first: Path, second: Path) -> bool:
    one, other = tensors(first), tensors(second)
    return one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)


def test_the_folder_is_an_avatar_with_clip_and_sheet(made: Path, tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    out = made / "my_hand"
    found = sorted(path.name for path in out.iterdir())
    files = ["avatar.html", "avatar.json", "model.safetensors", "sheet.jpg", "turntable.mp4"]
    files += ["weights", "work"]
    assert found == files
    capture = open_capture(out / "work" / "capture")
    assert (capture.info.id, len(capture)) == ("my_hand", COUNT)
    with av.open(str(out / "turntable.mp4")) as container:
        assert container.streams.video[0].codec_context.name == "h264"
    clip = cv2.VideoCapture(str(out / "turntable.mp4"))
    views = []
    while (read := clip.read())[0]:
        views.append(read[1])
    assert len(views) == SMALL[1]
    # The hand is there, and turns.
    assert all((view.max(axis=2) > 60).mean() > 0.05 for view in views)
    assert np.abs(views[0].astype(int) - views[SMALL[1] // 2]).mean() > 1
    assert read_rgb(out / "sheet.jpg").shape[0] > 1000
    # What other commands expect of an avatar.
    words = ["render", str(out), "--poses", str(out / "work" / "capture"), "--range", "3:5"]
    assert main([*words, "-o", str(tmp_path / "frames")]) == 0
    assert main(["export", str(out), "-o", str(tmp_path / "hand.ply")]) == 0


def test_the_same_command_keeps_everything(folder: Path, capsys) -> None:
    before = (folder / "my_hand" / "turntable.mp4").stat().st_mtime_ns
    result = make_avatar(folder / "hand.avi", folder / "my_hand", choices(folder))
    assert list(result.kept) == NAMES
    assert result.avatar.folder == folder / "my_hand"
    assert (folder / "my_hand" / "turntable.mp4").stat().st_mtime_ns == before
    assert "all is done already" in capsys.readouterr().err


def test_the_avatar_of_a_video_is_not_taken_for_that_of_a_captures_call(folder: Path) -> None:
    """Oracle: `fit_capture` takes what has the call's file for complete."""
    out = folder / "my_hand"
    (out / CALL).write_text('{"call": "of the capture that was fitted here before"}')
    Place().run(VideoJob(folder / "hand.avi", out, choices(folder)))
    assert not (out / CALL).exists()
    assert same(out, out / "work" / "avatar")


@pytest.mark.parametrize(
    ("changes", "again", "named"),
    [
        ({"seed": 1}, NAMES[2:], "seed"),
        ({"all_frames": False}, NAMES[2:], "choice of frames"),
        ({"size": 128}, NAMES[1:], "size"),
        # The side that is named is the one that was found: the capture stays what it was, and so
        # does all that depends on it.
        ({"side": "right"}, ["import"], "side"),
    ],
)
def test_what_changed_is_named_and_made_again(
    changes: dict[str, Any], again: list[str], named: str, folder: Path, capsys
) -> None:
    result = make_avatar(folder / "hand.avi", folder / "my_hand", choices(folder, **changes))
    assert [name for name in NAMES if name not in result.kept] == again
    assert f"changed since the last run: {named}." in capsys.readouterr().err
    fitted = COUNT - 2 if changes.get("all_frames", True) else round(0.8 * COUNT)
    assert len(result.avatar.record.frames) == pytest.approx(fitted, abs=1)


def test_what_another_version_has_fitted_is_fitted_again(
    folder: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stages, "STATE_SCHEMA", "wildghand-fit/0")
    result = make_avatar(folder / "hand.avi", folder / "my_hand", choices(folder))
    assert result.kept[:2] == ("track", "import")
    assert "fit" not in result.kept
    assert "changed since the last run: version." in capsys.readouterr().err


def test_what_is_imported_needs_no_room_for_an_import(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=0))
    result = make_avatar(folder / "hand.avi", folder / "my_hand", choices(folder))
    assert list(result.kept) == NAMES
    with pytest.raises(UsageError, match="of disk"):
        make_avatar(folder / "hand.avi", folder / "my_hand", choices(folder, size=128))


def test_another_video_of_the_same_name_is_noticed(folder: Path, capsys) -> None:
    clip = make_clip(COUNT, bend=0.2)
    write_video(folder / "hand.avi", [clip.picture(frame) for frame in range(COUNT)])
    result = make_avatar(folder / "hand.avi", folder / "my_hand", choices(folder))
    assert "Importing the hand again; changed since the last run: video." in capsys.readouterr().err
    assert "import" not in result.kept


#: Ends its own process, as hard as can be, within a stage: argument 3 says where.
KILLED = """
import os, signal, sys
from pathlib import Path
sys.path[:0] = sys.argv[4:]
from test_from_video import SMALL, choices
from wildghand.fitting import session
from wildghand.from_video import make_avatar, run, stages
folder, out, where = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
stages.SIZE, stages.FRAMES = SMALL
def die(*args, **more):
    os.kill(os.getpid(), signal.SIGKILL)
if where == "fit":
    session.SAVE_EVERY, save = 0.0, session.save_state
    def save_and_die(*args, **more):
        save(*args, **more)
        if more["step"] == 3:
            die()
    session.save_state = save_and_die
elif where == "import":
    stages.import_video = die
elif where == "turntable":
    stages.as_uint8 = die
elif where == "between":
    write = run.write_record
    def write_and_die(path, record):
        write(path, record)
        if record.stages["import"].done:
            die()
    run.write_record = write_and_die
make_avatar(folder / "hand.avi", out, choices(folder))
"""


@pytest.mark.parametrize(
    ("where", "kept", "told"),
    [
        ("import", 1, "Importing the hand once more: the last run was stopped there."),
        ("between", 2, "Done before and kept: track, import."),
        ("fit", 2, "Continuing after 3 steps."),
        ("turntable", 4, "Drawing the turntable once more: the last run was stopped there."),
    ],
)
def test_a_killed_run_goes_on_to_the_same_avatar(
    where: str, kept: int, told: str, folder: Path, made: Path, capsys
) -> None:
    """Oracle: the run that was never stopped."""
    # What the module's run had done before the stage is taken over, to save time.
    out = folder / "my_hand"
    record = json.loads((out / "work" / "stages.json").read_text())
    place = {"between": 1, "import": 1, "fit": 2, "turntable": 4}[where]
    record["stages"] = {name: record["stages"][name] for name in NAMES[:place]}
    (out / "work" / "stages.json").write_text(json.dumps(record))
    tests = Path(__file__).resolve().parents[2]
    words = (str(folder), str(out), where, str(tests), str(Path(__file__).parent))
    ended = subprocess.run([sys.executable, "-c", KILLED, *words], capture_output=True, text=True)
    assert ended.returncode == -9, ended.stderr
    result = make_avatar(folder / "hand.avi", out, choices(folder))
    assert len(result.kept) == kept
    assert told in capsys.readouterr().err
    assert result.avatar.steps == STEPS
    assert same(out, made / "my_hand")


def test_the_command(folder: Path, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = functools.partial(VideoFit, importer=IMPORT)
    monkeypatch.setattr("wildghand.from_video.VideoFit", tiny)
    sets = [
        word for name, value in SETTINGS.items() for word in ("--set", f"{name}={value}".lower())
    ]
    words = ["fit", str(folder / "hand.avi"), "--landmarks", str(folder / "hand.npz"), *sets]
    assert main([*words, "-o", str(folder / "my_hand"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["hands"] == ["right"]
    assert facts["steps"] == STEPS
    assert [stage["name"] for stage in facts["stages"]] == NAMES
    assert all(stage["kept"] for stage in facts["stages"])
    assert (facts["video"]["decoded_frames"], facts["video"]["ends_early"]) == (COUNT, False)
    assert facts["video"]["codec"] == "mjpeg"
    for name in ("avatar", "turntable", "sheet", "capture"):
        assert Path(facts[name]).exists()
    # The palm is all that the clip shows.
    verdict = facts["verdict"]
    assert verdict["film_next"][0].startswith("the back was never seen: turn the hand over")
    assert verdict["pose_error_px"] == {"right": pytest.approx(1.0, abs=1.0)}
    assert main([*words, "-o", str(folder / "my_hand")]) == 0
    said = capsys.readouterr().out
    assert "turntable: " in said
    assert "verdict: " in said
    assert "film next: the back was never seen: turn the hand over for three seconds" in said
    assert "video: " not in said
    # What the import took down is said by later runs too, and stands on the sheet.
    capture = folder / "my_hand" / "work" / "capture"
    record = json.loads((capture / "capture.json").read_text())
    record["source"]["video"] |= {"ends_early": True, "warning": "ends early, after 12 of 24"}
    (capture / "capture.json").write_text(json.dumps(record))
    labels: list[str] = []
    labelled = stages.labelled
    monkeypatch.setattr(
        stages, "labelled", lambda tile, text: labels.append(text) or labelled(tile, text)
    )
    (folder / "my_hand" / "sheet.jpg").unlink()
    assert main([*words, "-o", str(folder / "my_hand")]) == 0
    assert "video: ends early, after 12 of 24" in capsys.readouterr().out
    assert sum("(video ends early)" in label for label in labels) == 1
    assert any(label.startswith("verdict: ") for label in labels)
    assert any(label.startswith("film next: the back") for label in labels)


def test_from_python(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a folder it goes next to the video, under the video's name."""
    monkeypatch.setattr(
        "wildghand.from_video.make.VideoFit", functools.partial(VideoFit, importer=IMPORT)
    )
    (folder / "my_hand").rename(folder / "hand_avatar")
    avatar = wildghand.fit(
        folder / "hand.avi",
        landmarks=folder / "hand.npz",
        settings=SETTINGS,
    )
    assert avatar.folder == folder / "hand_avatar"
    assert avatar.steps == STEPS
    with pytest.raises(UsageError, match="side"):
        wildghand.fit(folder / "hand_avatar" / "work" / "capture", side="left")


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["absent.mp4"], 1, "does not exist"),
        (["text.mp4"], 1, "is not a video file of a kind that is read"),
        (["empty.mp4"], 1, "is empty"),
        (["hand.avi", "-o", "taken"], 2, "exists and is not the folder of an avatar"),
        (["hand.avi", "-o", "hand.npz"], 2, "is a file"),
        (["hand.avi", "--steps", "0"], 2, "--steps"),
        (["hand.avi", "--set", "gausians=3"], 1, "gaussians"),
        (["hand.avi", "--landmarks", "absent.npz"], 1, "absent.npz"),
        (["hand.avi", "--size", "16"], 2, "--size"),
        (["taken", "--side", "left", "-o", "x"], 2, "--side: is for videos"),
        (["taken", "--size", "512", "-o", "x"], 2, "--size: is for videos"),
        (["taken", "--hand-model", "mano:/etc", "-o", "x"], 2, "--hand-model: is for videos"),
        (["taken"], 2, "--out: is missing"),
    ],
)
def test_wrong_calls_are_one_line(
    words: list[str], status: int, message: str, folder: Path, capsys, monkeypatch
) -> None:
    monkeypatch.chdir(folder)
    (folder / "text.mp4").write_text("not a video\n" * 100)
    (folder / "empty.mp4").touch()
    (folder / "taken").mkdir()
    (folder / "taken" / "thesis.tex").touch()
    assert main(["fit", *words]) == status
    told = capsys.readouterr()
    assert told.out == ""
    error = told.err.splitlines()[-1]
    assert error.startswith("wildghand: error: ")
    assert message in error
    assert (folder / "taken" / "thesis.tex").exists()


def test_two_hands_by_default(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the synthetic clip has a right and a left hand."""
    video, landmarks = write_two_hands(tmp_path, make_two_hands(COUNT), (5,), range(7, 9))
    options = choices(tmp_path, landmarks=landmarks)
    result = make_avatar(video, tmp_path / "mine", options)
    assert result.facts()["hands"] == ["right", "left"]
    assert open_capture(result.job.capture).info.hands == "both"
    for path in (result.job.turntable, result.job.sheet, result.job.page):
        assert path.is_file()
    # A second hand of few frames is left out, unless it is asked for.
    tracks = read_hand_tracks(landmarks)
    assert tracks is not None
    score = np.where((np.arange(COUNT) < 10) | (tracks.right > 0.5), tracks.score, 0.0)
    write_hand_tracks(landmarks, replace(tracks, score=score.astype(np.float32)))
    capsys.readouterr()
    assert import_options(VideoJob(video, tmp_path / "other", options)).side == "right"
    assert "The left hand is in 8 of 16 frames only" in capsys.readouterr().err
    with pytest.raises(BadInput, match="shows a left hand in 8 of 16 frames"):
        make_avatar(video, tmp_path / "other", replace(options, side="both"))


def test_hands_that_are_hardly_seen_together_are_not_fitted_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """First one hand is shown, then the other, with a few frames of both between."""
    frames = 3 * COUNT
    video, landmarks = write_two_hands(tmp_path, make_two_hands(frames), (), range(0))
    tracks = read_hand_tracks(landmarks)
    assert tracks is not None
    right = np.arange(frames) < 2 * COUNT
    left = np.arange(frames) >= 2 * COUNT - 8
    seen = np.where(tracks.right > 0.5, right, left)
    score = np.where(seen, tracks.score, 0.0).astype(np.float32)
    write_hand_tracks(landmarks, replace(tracks, score=score))
    sides = read_sides(landmarks, "auto", min_score=0.5).values()
    both = int(np.all([hand.detected for hand in sides], axis=0).sum())
    assert 8 <= both <= 9
    options = choices(tmp_path, landmarks=landmarks)

    def chosen(**changes: Any) -> str:
        job = VideoJob(video, tmp_path / "mine", replace(options, **changes))
        return import_options(job).side

    assert chosen() == "right"
    told = " ".join(capsys.readouterr().err.split())
    assert f"Both hands are in {both} of {frames} frames only; the left hand is left out" in told
    with pytest.raises(BadInput, match=f"both hands together in {both} of {frames} frames"):
        chosen(side="both")
    assert chosen(side="left") == "left"


def test_too_few_frames_with_a_hand(folder: Path) -> None:
    clip = make_clip(COUNT)
    score = np.where(np.arange(COUNT) < 5, 0.9, 0.0)
    write_landmarks(folder / "hand.npz", clip.landmarks, score=score)
    with pytest.raises(BadInput, match="shows a hand in 5 of 16 frames") as caught:
        make_avatar(folder / "hand.avi", folder / "other", choices(folder))
    shown = folder / "other" / "work" / "tracked.jpg"
    assert str(shown) in str(caught.value)
    assert shown.is_file()


def test_frames_with_a_hand_are_counted_among_those_that_are_taken(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("wildghand.from_video.run.FRAMES", 4)  # every fourth of 16
    score = np.where(np.arange(COUNT) < 8, 0.9, 0.0)
    write_landmarks(folder / "hand.npz", make_clip(COUNT).landmarks, score=score)
    with pytest.raises(BadInput, match="in 2 of the 4 frames that are taken of 16"):
        make_avatar(folder / "hand.avi", folder / "other", choices(folder))


def test_a_phones_hdr_video_becomes_the_avatar_of_the_ordinary_one(
    made: Path, tmp_path: Path
) -> None:
    """Oracle: the frames of the ordinary video, as dark as those that were written; 3 levels."""
    clip = make_clip(COUNT)
    pictures = [np.rint(0.7 * clip.picture(frame)).astype(np.uint8) for frame in range(COUNT)]
    planes = [hlg_frame(picture) for picture in pictures]
    video = write_samples(tmp_path / "hand.mov", planes, "yuv420p10le", "libx265", marks=HLG)
    write_landmarks(tmp_path / "hand.npz", clip.landmarks)
    make_avatar(video, tmp_path / "my_hand", choices(tmp_path))
    assert (tmp_path / "my_hand" / "avatar.html").is_file()
    ordinary, hdr = (open_capture(one / "my_hand/work/capture") for one in (made, tmp_path))
    for frame in range(0, COUNT, 5):
        hand = (ordinary.mask(frame) > 127) & (hdr.mask(frame) > 127)
        assert hand.sum() > 1000
        means = [one.frame(frame)[hand].mean(axis=0) for one in (ordinary, hdr)]
        np.testing.assert_allclose(means[1], 0.7 * means[0], atol=3.0)


def test_what_is_advised_for_faint_hands_takes_them(
    folder: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: the landmarks that `data track --min-score 0.3` would write."""

    def unseen(*args: Any, **more: Any) -> None:
        raise NoHandSeen("none", where="v")

    monkeypatch.setattr(stages, "track_video", unseen)
    job = VideoJob(folder / "hand.avi", folder / "other", choices(folder, landmarks=None))
    with pytest.raises(NoHandSeen) as caught:
        TrackStage().run(job)
    advice = "hwp-bench data import video --landmarks NPZ --min-score 0.3"
    assert advice in str(caught.value)
    score = np.full(COUNT, 0.4)
    write_landmarks(folder / "faint.npz", make_clip(COUNT).landmarks, score=score)
    given = choices(folder, landmarks=folder / "faint.npz")
    with pytest.raises(BadInput, match=r"score of at least 0\.5"):
        import_options(VideoJob(folder / "hand.avi", folder / "other", given))
    hands = read_sides(folder / "faint.npz", "auto", min_score=0.3)
    assert all(hand.detected.all() for hand in hands.values())


def test_a_verdict_of_another_version_is_made_again_with_its_sheet(folder: Path) -> None:
    record = folder / "my_hand" / "work" / "stages.json"
    content = json.loads(record.read_text())
    for name in ("verdict", "sheet"):
        facts = content["stages"][name]["facts"]
        facts[f"look of the {name}"] = facts[f"look of the {name}"].replace("2", "1")
    record.write_text(json.dumps(content))
    result = make_avatar(folder / "hand.avi", folder / "my_hand", choices(folder))
    assert [name for name in NAMES if name not in result.kept] == ["verdict", "sheet"]


def test_a_video_of_no_use_is_refused_before_its_import(folder: Path, capsys) -> None:
    """The command says so in one line, and names the sheet."""
    clip = make_clip(COUNT)
    write_video(folder / "dark.avi", [clip.picture(frame) // 16 for frame in range(COUNT)])
    words = ["fit", str(folder / "dark.avi"), "--landmarks", str(folder / "hand.npz")]
    assert main([*words, "-o", str(folder / "other")]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert "no useful avatar can come of this video: the right hand is underexposed in 16" in error
    assert len(list((folder / "other" / "work").glob("capture_tracked_*.jpg"))) == 1
    assert not (folder / "other" / "work" / "capture").exists()


def test_what_a_job_needs_is_checked_before_its_folder_is_made(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, given = folder / "other", choices(folder)
    for name, full in (
        ("shutil.disk_usage", lambda path: SimpleNamespace(free=50_000_000)),
        ("psutil.virtual_memory", lambda: SimpleNamespace(available=400_000_000)),
    ):
        with monkeypatch.context() as here:
            here.setattr(name, full)
            with pytest.raises(UsageError, match=r"16 frames need about \d\.\d GB of (disk|mem)"):
                make_avatar(folder / "hand.avi", place, given)
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    monkeypatch.setattr(make, "load_models", lambda model: HandModels(b"", b"", "none"))
    with pytest.raises(MissingDependency, match=r"pip install 'hwp-bench\[track\]'|hand tracker"):
        make_avatar(folder / "hand.avi", place, replace(given, landmarks=None))
    assert not place.exists()


def test_without_the_tracker_or_the_network_one_line_says_so(
    folder: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["fit", str(folder / "hand.avi"), "-o", str(folder / "other")]

    def offline(address: str) -> Any:
        raise OSError("network is unreachable")

    with monkeypatch.context() as here:
        here.setenv("HWP_CACHE", str(folder / "cache"))
        here.setattr("hwp_bench.base.download.open_address", offline)
        assert main(words) == 1
        told = capsys.readouterr().err
        assert "cannot be downloaded (network is unreachable)" in told
        assert "hwp-bench data track --fetch" in told
        assert not (folder / "other").exists()
    if not all((models_folder() / name).is_file() for name in (PALM, HAND)):
        pytest.skip("the networks are not in the cache: hwp-bench data track --fetch")
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    assert main(words) == 1
    assert "pip install 'hwp-bench[track]'" in capsys.readouterr().err


def test_a_video_without_a_hand(tmp_path: Path, capsys) -> None:
    if not all((models_folder() / name).is_file() for name in (PALM, HAND)):
        pytest.skip("the networks are not in the cache: hwp-bench data track --fetch")
    write_video(tmp_path / "wall.avi", [np.full((96, 128, 3), 120, np.uint8)] * 3)
    assert main(["fit", str(tmp_path / "wall.avi")]) == 1
    told = capsys.readouterr().err
    assert "none of 3 frames shows a hand" in told
    assert (tmp_path / "wall_avatar" / "work" / "tracked.jpg").is_file()
    assert "--min-score 0.3" in told


def test_a_real_hand(tmp_path: Path) -> None:
    """The whole chain on 16 frames of a real video. Oracle: its hand is known to be a right one."""
    video = CLIP / "human_hand_video.mp4"
    if not video.is_file():
        pytest.skip("the real video is not here")
    if not all((models_folder() / name).is_file() for name in (PALM, HAND)):
        pytest.skip("the networks are not in the cache: hwp-bench data track --fetch")
    source, frames = cv2.VideoCapture(str(video)), []
    while len(frames) < COUNT:
        frames.append(source.read()[1][:, :, ::-1])
    write_video(tmp_path / "hand.avi", frames)
    options = VideoFit(importer=IMPORT, settings=SETTINGS)
    result = make_avatar(tmp_path / "hand.avi", None, options)
    assert result.job.folder == tmp_path / "hand_avatar"
    assert result.avatar.sides == ("right",)
    assert result.job.turntable.is_file()


def test_no_gaussian_of_a_video_is_wide(made: Path) -> None:
    """Oracle: the bound. A person's word wins over it, with and without `quick`."""
    model = load_avatar(made / "my_hand").model
    limit = model.network.activation.max_scale
    assert limit == VIDEO_CHANGES["max_scale"] < read_settings({}).max_scale
    raw = model.network.initial("right")
    wide = replace(raw, log_scales=torch.full_like(raw.log_scales, 9.0))
    assert model.network.activation(wide).scales.max() <= limit * (1 + 1e-6)
    for quick in (False, True):
        assert VideoFit(quick=quick).method_settings()["max_scale"] == limit
        said = VideoFit(quick=quick, settings={"max_scale": 0.005})
        assert read_settings(said.method_settings()).max_scale == 0.005


def test_opacities_of_a_videos_avatar_are_the_same_in_every_frame(made: Path) -> None:
    """Oracle: another pose, other normals. Other attributes do change."""
    network = load_avatar(made / "my_hand").model.network
    count = len(network.initial("right"))
    normals = torch.nn.functional.normalize(torch.randn(2, count, 3), dim=-1)
    with torch.no_grad():
        raw = network("right", normals, torch.randn(2, 16, 3)).raw
    assert torch.equal(raw.logit_opacities[0], raw.logit_opacities[1])
    assert not torch.equal(raw.logit_colors[0], raw.logit_colors[1])
    for quick in (False, True):
        assert not read_settings(VideoFit(quick=quick).method_settings()).network.frame_opacities
    assert read_settings({}).network.frame_opacities


def test_quick_takes_fewer_frames_and_smaller_fits() -> None:
    for count in (3, 100, 200, 299, 621, 1200, 5000):
        taken = len(range(0, count, stride(count, QUICK_FRAMES)))
        assert taken <= 1.5 * QUICK_FRAMES
        assert taken >= min(count, QUICK_FRAMES // 2)
    quick = read_settings(with_quick({}, quick=True))
    assert quick.gaussians == QUICK_CHANGES["gaussians"] < read_settings({}).gaussians
    video, hurried = (read_settings(VideoFit(quick=q).method_settings()) for q in (False, True))
    assert hurried.schedule == quick.schedule  # not the video's, which are more
    assert quick.schedule.steps < video.schedule.steps < read_settings({}).schedule.steps
    # A mode that counts epochs is hurried too, unless a person names a number of them.
    paper = VideoFit(quick=True, settings={"mode": "paper"}).method_settings()
    assert (read_settings(paper).schedule.steps, read_settings(paper).schedule.epochs) == (250, 0)
    paper = with_quick({"mode": "paper", "schedule.epochs": 3}, quick=True)
    assert read_settings(paper).schedule.epochs == 3
    # What a person says wins, in either form.
    for said in ({"schedule.steps": 5}, {"schedule": {"steps": 5}}):
        chosen = read_settings(with_quick(said, quick=True))
        assert (chosen.schedule.steps, chosen.gaussians) == (5, QUICK_CHANGES["gaussians"])
