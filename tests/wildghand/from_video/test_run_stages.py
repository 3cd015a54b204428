"""Stages that are kept, run again, stopped and continued. Oracle: the rules, written out again."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hwp_bench.base.errors import BadInput, HwpError, UsageError
from hwp_bench.tracking.networks import TASK_MEMBERS
from wildghand.from_video import make, make_avatar
from wildghand.from_video.run import (
    JobRecord,
    Stage,
    StageRecord,
    VideoFit,
    VideoJob,
    read_record,
    run_stages,
    seconds_left,
    stride,
    write_record,
)
from wildghand.from_video.stages import FitStage, TrackStage

NAMES = ("one", "two", "three")


@pytest.mark.parametrize(
    ("option", "given"),
    [
        ("--budget", {"seconds": float("inf")}),
        ("--budget", {"seconds": 2e9}),
        ("--seed", {"seed": 2**63}),
        ("--steps", {"steps": 2**54}),
    ],
)
def test_what_the_fit_would_refuse_is_refused_before_tracking(
    option: str, given: dict[str, Any]
) -> None:
    with pytest.raises(UsageError, match=option):
        VideoFit(**given)


class _Step(Stage):
    """Writes its input and the result of the stage before it to a file."""

    def __init__(self, workshop: Workshop, name: str, before: str | None) -> None:
        self.workshop, self.name, self.before = workshop, name, before
        self.title = f"Doing {name}"

    def _old(self) -> str:
        return "" if self.before is None else self.workshop.result(self.before).read_text()

    def facts(self, job: VideoJob) -> dict[str, str]:
        old = {} if self.before is None else {self.before: self._old()}
        return {**old, f"input of {self.name}": self.workshop.inputs[self.name]}

    def result(self, job: VideoJob) -> Path:
        return self.workshop.result(self.name)

    def run(self, job: VideoJob) -> None:
        self.workshop.ran.append(self.name)
        if self.workshop.stop_in == self.name:
            raise KeyboardInterrupt
        made = f"{self._old()}{self.name}:{self.workshop.inputs[self.name]};"
        self.result(job).write_text(made)

    def expected(self, job: VideoJob) -> float:
        return 1.0

    def discard(self, job: VideoJob) -> None:
        self.workshop.discarded.append(self.name)


class Failing(_Step):
    def run(self, job: VideoJob) -> None:
        raise HwpError("no luck")


class Workshop:
    """Three stages, one on the other."""

    def __init__(self, folder: Path) -> None:
        self.job = VideoJob(folder / "video.mp4", folder / "hand", VideoFit())
        self.inputs = dict.fromkeys(NAMES, "a")
        self.ran: list[str] = []
        self.discarded: list[str] = []
        self.stop_in = ""

    def result(self, name: str) -> Path:
        return self.job.work / name

    def stage(self, name: str, before: str | None) -> Stage:
        return _Step(self, name, before)

    @property
    def stages(self) -> list[Stage]:
        return [self.stage(*pair) for pair in zip(NAMES, (None, *NAMES), strict=False)]

    def go(self) -> list[str]:
        """Run the stages; returns the names of those that ran."""
        self.ran, self.discarded = [], []
        self.job.work.mkdir(parents=True, exist_ok=True)
        run_stages(self.job, self.stages)
        return self.ran


@pytest.fixture
def workshop(tmp_path: Path) -> Workshop:
    return Workshop(tmp_path)


def test_a_second_run_does_nothing_and_says_so(workshop: Workshop, capsys) -> None:
    assert workshop.go() == list(NAMES)
    assert "[1/3] Doing one (0:00 elapsed, about 0:03 left)" in capsys.readouterr().err
    assert workshop.go() == []
    assert "all is done already" in capsys.readouterr().err


@pytest.mark.parametrize("name", NAMES)
def test_a_stage_that_was_stopped_goes_on(name: str, workshop: Workshop, capsys) -> None:
    workshop.stop_in = name
    with pytest.raises(KeyboardInterrupt):
        workshop.go()
    workshop.stop_in = ""
    capsys.readouterr()
    place = NAMES.index(name)
    assert workshop.go() == list(NAMES[place:])
    # What it left behind is of the same inputs.
    assert name not in workshop.discarded
    told = capsys.readouterr().err
    assert f"Doing {name} once more: the last run was stopped there." in told
    assert ("Done before and kept: one" in told) is (place > 0)
    assert workshop.result("three").read_text() == "one:a;two:a;three:a;"


@pytest.mark.parametrize("name", NAMES)
def test_a_stopped_stage_with_other_inputs_begins_again(name: str, workshop: Workshop) -> None:
    workshop.stop_in = name
    with pytest.raises(KeyboardInterrupt):
        workshop.go()
    workshop.stop_in, workshop.inputs[name] = "", "b"
    workshop.go()
    assert name in workshop.discarded
    assert f"{name}:b;" in workshop.result("three").read_text()


def test_a_missing_result_is_made_again(workshop: Workshop, capsys) -> None:
    workshop.go()
    workshop.result("two").unlink()
    assert workshop.go() == ["two"]
    assert "Doing two once more: its result is missing." in capsys.readouterr().err


@given(st.dictionaries(st.sampled_from(NAMES), st.sampled_from("abc"), max_size=3))
def test_what_builds_on_a_change_is_made_again(tmp_path_factory, changes: dict[str, str]) -> None:
    workshop = Workshop(tmp_path_factory.mktemp("job"))
    workshop.go()
    workshop.inputs |= changes
    first = [place for place, name in enumerate(NAMES) if workshop.inputs[name] != "a"]
    assert workshop.go() == (list(NAMES[first[0] :]) if first else [])
    expected = "".join(f"{name}:{workshop.inputs[name]};" for name in NAMES)
    assert workshop.result("three").read_text() == expected


def test_a_change_is_named(workshop: Workshop, capsys) -> None:
    workshop.go()
    workshop.inputs["two"] = "b"
    workshop.go()
    told = capsys.readouterr().err
    assert "Doing two again; changed since the last run: input of two." in told
    assert "Doing three again; changed since the last run: two." in told


def test_a_failing_stage_is_not_done(workshop: Workshop) -> None:
    workshop.job.work.mkdir(parents=True)
    with pytest.raises(HwpError, match="no luck"):
        run_stages(workshop.job, [Failing(workshop, "one", None)])
    assert workshop.go() == list(NAMES)


def test_stages_of_another_version_are_forgotten(workshop: Workshop) -> None:
    workshop.go()
    record, kept = run_stages(workshop.job, workshop.stages[:1])
    assert (list(record.stages), kept) == (["one"], ["one"])


@pytest.mark.parametrize(
    "content", ["", "[]", '{"schema": "wildghand-stages/9"}', '{"stages": {"a": {"facts": 3}}}']
)
def test_a_damaged_record_is_one_line(content: str, tmp_path: Path) -> None:
    path = tmp_path / "stages.json"
    path.write_text(content)
    with pytest.raises(BadInput, match="Delete it, or give --overwrite") as caught:
        read_record(path)
    assert "\n" not in str(caught.value)


def test_a_record_is_read_as_it_was_written(tmp_path: Path) -> None:
    stage = StageRecord({"video": "0a"}, True, 1.5, 2.5)
    record = JobRecord(stages={"one": stage})
    write_record(tmp_path / "stages.json", record)
    assert read_record(tmp_path / "stages.json") == record
    assert read_record(tmp_path / "absent.json") == JobRecord()
    # The format is read by later versions.
    assert json.loads((tmp_path / "stages.json").read_text())["schema"] == "wildghand-stages/1"
    assert stage.changed({"video": "0a"}) == []
    assert stage.changed({"video": "0b", "side": "left"}) == ["video", "side"]


def test_the_time_that_is_left_goes_by_what_was_measured() -> None:
    """Oracle: by hand. Stages that were kept say nothing of this machine."""
    expected = [10.0, 20.0, 30.0]
    assert seconds_left(expected, {}, 1) == (20.0, 30.0)
    assert seconds_left(expected, {1: 40.0}, 2) == (60.0, 0.0)


@pytest.mark.parametrize(
    ("file", "problem", "remedy"),
    [
        ("avatar.json", "whose folder work is gone, or that was made of a capture", "--overwrite"),
        ("thesis.tex", "is not the folder of an avatar", "or delete it."),
    ],
)
def test_a_folder_without_a_record_is_refused_by_what_is_in_it(
    file: str, problem: str, remedy: str, tmp_path: Path
) -> None:
    (tmp_path / "hand").mkdir()
    (tmp_path / "hand" / file).touch()
    with pytest.raises(UsageError, match=problem) as caught:
        make_avatar(tmp_path / "hand.mp4", tmp_path / "hand")
    assert remedy in str(caught.value)
    assert ("--overwrite" in str(caught.value)) == (remedy == "--overwrite")


@pytest.mark.parametrize(
    "settings",
    [
        {"prior": "/none"},
        {"pao.hand": "sam:/none"},
        {"perceptual": "vgg19:/none", "terms.perceptual": 0.1},
        {"perceptual": "vgg19:/none"},
    ],
    ids=str,
)
def test_files_of_the_fit_are_looked_for_before_the_video_is_read(
    settings: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(make, "probe", lambda video: pytest.fail("the video was read"))
    with pytest.raises((BadInput, UsageError), match=r"prior|exist|terms\.perceptual is 0"):
        make_avatar(tmp_path / "hand.mp4", tmp_path / "hand", VideoFit(settings=settings))
    assert not (tmp_path / "hand").exists()


def test_epochs_are_expected_to_take_their_steps(tmp_path: Path) -> None:
    def seconds(**settings: Any) -> float:
        options = VideoFit(settings=settings)
        return FitStage().expected(VideoJob(tmp_path / "hand.mp4", tmp_path / "hand", options))

    # Ten looks at about 300 frames, two in a step.
    schedule = {"schedule.epochs": 10, "schedule.batch": 2}
    counted = {"schedule.steps": 3000, "schedule.batch": 1}
    assert seconds(**schedule) == pytest.approx(seconds(**counted))
    assert seconds(**schedule) > 2 * seconds()


@pytest.mark.parametrize(("count", "quick"), [(16, False), (449, False), (151, True), (9000, True)])
def test_room_is_asked_for_as_many_frames_as_are_imported(
    count: int, quick: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: a range in steps of the stride, as the import takes them."""
    monkeypatch.setattr(make, "probe", lambda video: SimpleNamespace(stated_frames=count))
    monkeypatch.setattr(make, "check_encoder", lambda: None)
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=0))
    options = VideoFit(landmarks=tmp_path / "hand.npz", quick=quick)
    taken = len(range(0, count, stride(count, options.most_frames)))
    with pytest.raises(UsageError, match=rf": {taken} frames need about"):
        make_avatar(tmp_path / "hand.mp4", tmp_path / "hand", options)


def test_another_network_at_the_same_place_tracks_again(tmp_path: Path) -> None:
    (tmp_path / "hand.mp4").touch()
    model, facts = tmp_path / "hand_landmarker.task", []
    job = VideoJob(tmp_path / "hand.mp4", tmp_path / "hand", VideoFit(tracker=model))
    for content in (b"one", b"two", b"one"):
        with zipfile.ZipFile(model, "w") as archive:
            for name in TASK_MEMBERS:
                archive.writestr(name, b"....TFL3" + content)
        facts.append(TrackStage().facts(job))
    assert facts[0] == facts[2] != facts[1]


def test_networks_are_refused_where_landmarks_are_given() -> None:
    with pytest.raises(UsageError, match="--model: is for tracking"):
        VideoFit(landmarks=Path("hand.npz"), tracker=Path("hand_landmarker.task"))
