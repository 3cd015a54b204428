"""Outputs in outputs, in inputs and in captures. Oracle: what lies on the disc before and after."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_results import made_results
from small_captures import CaptureMaker

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import check_places
from hwp_bench.cli.main import main
from hwp_bench.results import write_results
from wildghand.cli.main import main as wildghand
from wildghand.from_video.make import fit

#: Commands whose output would mix with another output, an input or a capture; C is a capture, R
#: and S are results, V a video, L landmarks, M a method, A an avatar, B one of a video, X nothing.
#: Then what is said.
WRONG = [
    ("wildghand render A --poses C -o X --video X/x.mp4", "--video: lies in the output --out"),
    ("wildghand render A --poses C -o X --video X", "is the output --video too"),
    ("wildghand render A --poses C -o X/x.mp4/y --video X/x.mp4", "lies in the output --video"),
    ("wildghand render A --poses C -o C/frames --overwrite", "lies in the input --poses"),
    ("wildghand render A --poses C -o A --overwrite", "is the input AVATAR too"),
    ("wildghand render A --poses C -o . --overwrite", "holds the input AVATAR"),
    ("wildghand fit C -o C --overwrite", "is the input VIDEO|CAPTURE too"),
    ("wildghand fit V -o V", "is the input VIDEO|CAPTURE too"),
    ("wildghand fit V -o C --overwrite", "is a capture"),
    ("wildghand fit C -o C/avatar", "lies in the input"),
    ("wildghand fit C -o M --overwrite", "is a folder with something else than an avatar"),
    ("wildghand fit C -o M", "Choose another name, or delete it."),
    ("wildghand fit C -o B --overwrite", "is a folder with something else than an avatar"),
    ("wildghand fit C -o L --overwrite", "is a file"),
    ("wildghand fit C -o X --tensorboard X/logs", "--tensorboard: lies in the output --out"),
    ("wildghand fit V.mp4 --tensorboard V_avatar/logs", "lies in the output --out"),
    ("wildghand fit C -o X --budget 2e9", "--budget: must be more than 0"),
    ("wildghand fit C -o X --steps 0", "--steps: must be 1 to"),
    ("wildghand judge C -o L", "--out: exists"),
    ("wildghand judge C -o X --picture L", "--picture: exists"),
    ("wildghand explain A C -o L", "--out: exists"),
    ("wildghand pretrain C -o . --overwrite", "holds the input CAPTURE"),
    ("wildghand pretrain C captures/c -o M --overwrite", "something else than a prior"),
    ("wildghand export A -o A/hand.ply", "lies in the input AVATAR"),
    ("wildghand page A -o C/hand.html", "lies in the capture"),
    ("wildghand judge C -o X.json --picture X.json", "is the output --picture too"),
    ("wildghand judge C -o C/judged.json", "lies in the input CAPTURE"),
    ("wildghand explain A C -o C/capture.json", "lies in the input CAPTURE"),
    ("sim render all -o C", "is a capture"),
    ("sim render capture0 -o C/x", "lies in the capture"),
    ("sim render --suite smoke -o C", "is a capture"),
    ("sim render capture0 -o M --overwrite", "something else than a capture"),
    ("sim preview capture0 -o C", "is a capture"),
    ("report R S -o C", "is a capture"),
    ("report R S -o C/report", "lies in the capture"),
    ("report R S -o R", "is the input RESULTS too"),
    ("report R S -o site", "--out: exists"),
    ("curves R S -o S/cost", "lies in the input RESULTS"),
    ("evaluate M --capture C -o C/runs", "lies in the input --capture"),
    ("evaluate M --capture C -o M/runs", "lies in the input METHOD_DIR"),
    ("evaluate M --capture captures/c -o .", "holds the input --capture"),
    ("ablate wildghand --capture C -o C", "is the input --capture too"),
    ("error-budget M --capture C -o M", "is the input METHOD_DIR too"),
    ("demo --methods M --out M/demo", "lies in the input METHOD_DIR"),
    ("data show C -o C/frames/000000.png", "lies in the input CAPTURE"),
    ("data show C -o L", "--out: exists"),
    ("challenge publish C -o C/public", "lies in the input CAPTURES"),
    ("data inputs --capture C -o C/inputs", "lies in the input --capture"),
    ("data track V -o V", "is the input VIDEO too"),
    ("data track V -o X.npz --sheet X.npz", "is the output --sheet too"),
    ("data import video V --landmarks L -o C/x", "lies in the capture"),
    ("data import video V --landmarks L -o X --sheet X/s.png", "lies in the output --out"),
    ("data import video V --landmarks L -o X --sheet L", "is the input --landmarks too"),
    ("data import interhand26m D seq -o D", "is the input DIR too"),
    ("data import wildghand D -o D/made", "lies in the input DIR"),
    ("data convert C -o C --hand-model anny --overwrite", "is the input CAPTURE too"),
    ("data convert C -o M --hand-model anny --overwrite", "something else than a capture"),
    ("data import video V --landmarks L -o M --overwrite", "something else than a capture"),
    ("data convert C -o . --hand-model anny --overwrite", "holds the input CAPTURE"),
    ("data export C -o C/hand.glb", "lies in the input CAPTURE"),
    ("data export C -o hand.obj", "--out: exists"),
    ("leaderboard submit R -o R/submission", "lies in the input RESULTS"),
    ("leaderboard build -o C", "is a capture"),
    ("challenge reveal D -o D/public/revealed.json", "lies in the input SUITE"),
    ("challenge check D revealed --work D/work", "lies in the input PUBLIC"),
    ("challenge make capture0 -o C", "is a capture"),
]


def listing(folder: Path) -> dict[str, tuple[int, int]]:
    facts = {path: path.stat() for path in folder.rglob("*") if path.is_file()}
    return {str(path): (fact.st_size, fact.st_mtime_ns) for path, fact in facts.items()}


@pytest.fixture
def here(make_capture: CaptureMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    make_capture("C", frames=12)
    make_capture("c", frames=12).root.rename(tmp_path / "moved")
    (tmp_path / "captures").mkdir()
    (tmp_path / "moved").rename(tmp_path / "captures" / "c")
    for name, level in (("R", 25.0), ("S", 20.0)):
        made = made_results(name.lower(), lambda c, f, s, level=level: level + c)
        write_results(tmp_path / name / "results.json", made)
    for name in ("A", "B", "D", "M"):
        (tmp_path / name).mkdir()
    for name in ("avatar.json", "turntable.mp4"):
        (tmp_path / "B" / name).write_text("of a video")
    (tmp_path / "M" / "method.toml").write_text(
        'schema = "hwp-method/1"\ntraining = "none"\n'
        'name = "m"\n[entry]\npredictions = "predictions"\n'
    )
    (tmp_path / "M" / "predictions").mkdir()
    (tmp_path / "site").mkdir()
    for name in ("V", "L", "revealed", "hand.obj", "site/index.html"):
        (tmp_path / name).write_text("not read")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("command", "said"), WRONG)
def test_no_command_writes_where_something_else_is(
    command: str, said: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = listing(here)
    words = command.split()
    status = wildghand(words[1:]) if words[0] == "wildghand" else main(words)
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
    assert status == 2
    assert listing(here) == before


@pytest.mark.usefixtures("here")
def test_a_report_replaces_a_report_and_another_page_where_that_is_asked_for() -> None:
    assert main(["report", "R", "S", "-o", "site", "--overwrite"]) == 0
    assert main(["report", "R", "S", "-o", "site"]) == 0
    for command in ("data show C -o L.png", "data export C -o hand.obj"):
        assert main([*command.split(), "--overwrite"]) == 0


def test_from_python_a_fit_does_not_replace_what_holds_its_capture(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    capture = make_capture(folder=tmp_path / "my_hand" / "work").root
    for out, problem in (
        (tmp_path / "my_hand", "out: holds the input source"),
        (capture / "avatar", "out: lies in the input source"),
    ):
        with pytest.raises(UsageError, match=problem):
            fit(capture, out, steps=1, overwrite=True)
    assert (capture / "capture.json").is_file()


def test_places_that_are_fine(make_capture: CaptureMaker, tmp_path: Path) -> None:
    capture = make_capture("C", frames=12).root
    free = tmp_path / "free"
    check_places({"a": free, "b": tmp_path / "free2", "c": None}, {"d": [capture], "e": None})
    check_places({"a": tmp_path}, {"d": capture})  # a folder of captures may get something more
    check_places({"a": capture}, {}, makes_captures=True)  # one that is there is replaced, or not
    with pytest.raises(UsageError, match="is the output b too"):
        check_places({"a": free, "b": free / ".." / "free"}, {})
    link = tmp_path / "link"
    link.symlink_to(capture, target_is_directory=True)
    with pytest.raises(UsageError, match="lies in the input d"):
        check_places({"a": link / "x"}, {"d": capture})
