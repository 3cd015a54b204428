"""The command line: help without torch, exit statuses, one line for every error."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_captures import CaptureMaker, split_file

from hwp_bench.capture import CaptureWriter
from hwp_bench.capture.folder import rewrite_capture
from hwp_bench.cli.main import command_tree, main
from hwp_bench.cli.program import Command

HEAVY = ("torch", "numpy", "cv2", "scipy", "rich", "OpenImageIO", "numba", "trimesh")


def leaves(tree: Command, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    found = []
    for name, command in tree.commands.items():
        here = (*path, name)
        found += leaves(command, here) if command.commands else [here]
    return found


@pytest.mark.parametrize("words", [(), *leaves(command_tree())], ids=" ".join)
def test_help_has_examples_and_imports_nothing_heavy(words: tuple[str, ...]) -> None:
    script = (
        "import sys\n"
        "from hwp_bench.cli.main import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit as stop:\n    assert stop.code == 0\n"
        f"loaded = [name for name in {HEAVY} if name in sys.modules]\n"
        "print('LOADED', loaded)\n"
    )
    command = [sys.executable, "-c", script, *words, "--help"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "LOADED []" in shown
    assert "usage: hwp-bench" in shown
    if words:
        assert "example" in shown


def test_no_command_and_unknown_commands_are_usage_errors(capsys) -> None:
    assert main([]) == 2
    for words in (["evalute"], ["data", "chek"], ["evaluate"], ["--nothing"]):
        with pytest.raises(SystemExit) as stop:
            main(words)
        assert stop.value.code == 2
    errors = capsys.readouterr()
    assert "did you mean 'evaluate'?" in errors.err
    assert "did you mean 'check'?" in errors.err
    assert errors.out == ""


@pytest.mark.parametrize(
    ("words", "status", "problem"),
    [
        (["evaluate", "nowhere"], 1, "nowhere: is not a method directory"),
        (["evaluate", "baselines/plain", "--capture", "nowhere"], 1, "nowhere: is not a capture"),
        (["evaluate", "plain", "--capture", "x", "--budget", "-3"], 2, "--budget: -3.0"),
        (["evaluate", "plain", "--capture", "x", "--memory-limit", "1e300"], 2, "1e-9 to 1e9 GB"),
        (["evaluate", "plain", "--capture", "x", "--set", "a b=1"], 2, "is not NAME=VALUE"),
        (["evaluate", "plain", "--capture", "x", "--set", "a.=1"], 2, "is not NAME=VALUE"),
        (["evaluate", "wildghand", "--capture", "x", "--set", "heads=false"], 1, "not a capture"),
        (["evaluate", "plain", "--capture", "x", "--set", "stps=1"], 1, "Did you mean 'steps'"),
        (["ablate", "plain", "--capture", "x", "--set", "stps=1"], 1, "Did you mean 'steps'"),
        (["table", "nowhere"], 1, "does not exist"),
        (["data", "show", "nowhere"], 1, "is not a capture"),
        (["data", "check", "x", "--guard", "-1"], 2, "--guard"),
    ],
)
def test_errors_are_one_line_on_standard_error(
    words, status: int, problem: str, capsys, tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == status
    captured = capsys.readouterr()
    assert captured.out == ""
    assert problem in captured.err
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("hwp-bench: error: ")
    assert list(tmp_path.iterdir()) == []


def test_check_speaks_json_of_capture_and_split(make_capture: CaptureMaker, capsys) -> None:
    capture = make_capture(frames=20)
    assert main(["data", "check", "--json", str(capture.root)]) == 0
    report = json.loads(capsys.readouterr().out)[0]
    assert report["ok"]
    assert report["facts"]["frame_count"] == 20
    assert report["split"]["ok"]
    assert report["split"]["counts"] == {"train": 16, "validation": 2, "test": 2}
    (capture.root / "frames" / "000004.png").write_bytes(b"")
    assert main(["data", "check", str(capture.root)]) == 1
    assert "000004.png: is empty" in capsys.readouterr().out


def test_a_capture_without_a_split_does_not_keep_others_from_being_checked(
    make_capture: CaptureMaker, tmp_path: Path, capsys
) -> None:
    short, long = make_capture("short", frames=8), make_capture("long", frames=20)
    words = ["data", "check", str(short.root), str(long.root)]
    assert main([*words, "--json"]) == 1
    first, second = json.loads(capsys.readouterr().out)
    [finding] = first["findings"]
    assert (first["ok"], first["split"], finding["level"]) == (False, None, "error")
    assert finding["where"] == str(short.root)
    assert finding["problem"] == "has 8 frames, too few to split 80/10/10"
    assert second["ok"]
    assert second["split"]["ok"]
    splits = split_file(tmp_path / "splits.json", "short", [0, 4], 8)
    assert main([*words, "--splits", splits]) == 1
    out = capsys.readouterr().out
    assert "short: fair" in out
    assert "long: is not in the split file. The file lists: short." in out


def test_a_capture_that_no_evaluation_takes_is_not_sound(
    make_capture: CaptureMaker, tmp_path: Path, capsys
) -> None:
    one = make_capture(frames=20)
    with CaptureWriter(tmp_path / "thin", one.info, one.hands, one.cameras) as writer:
        for frame in range(20):
            writer.frame(frame, one.frame(frame))
            writer.mask(frame, one.mask(frame) * (frame != 18))
    assert main(["data", "check", str(tmp_path / "thin")]) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "the mask of test frame 18 leaves no pixel to score" in out


def test_no_gap_is_recommended_that_a_split_cannot_have(
    make_capture: CaptureMaker, tmp_path: Path, capsys
) -> None:
    capture = make_capture(frames=20)
    frames = capture.root / "frames"
    (frames / "000018.png").write_bytes((frames / "000005.png").read_bytes())
    rewrite_capture(capture, tmp_path / "copied", capture.info, capture.hands)
    assert main(["data", "check", str(tmp_path / "copied")]) == 0
    assert "no gap removes them" in " ".join(capsys.readouterr().out.split())


def test_lists_speak_json(capsys) -> None:
    assert main(["list", "--json"]) == 0
    value = json.loads(capsys.readouterr().out)
    assert [row["capture"] for row in value["captures"]] == [f"capture{i}" for i in range(11)]
    suites = ["smoke", "mini", "full-lite", "full", "wild-dev", "wild-test", "persistent"]
    suites += [f"persistent-clean{percent}" for percent in (0, 20, 35, 60)]
    suites.append("real-1")
    assert [row["suite"] for row in value["suites"]] == suites
    uses = {row["method"]: row["validation frames"] for row in value["methods"]}
    assert uses["plain"] == "earlier-state"
    assert uses["wildghand"] == "earlier-state, settings, shape, clean-frames"


def test_evaluate_prints_the_table_and_says_where_things_are(
    make_capture: CaptureMaker, tmp_path: Path, capsys
) -> None:
    from hwp_bench.base.images import write_image

    capture = make_capture(frames=20, size=48)
    entry = tmp_path / "entry"
    for frame in (18, 19):
        write_image(entry / "predictions" / "tiny" / f"{frame:06d}.png", capture.frame(frame))
    (entry / "method.toml").write_text(
        'schema = "hwp-method/1"\ntraining = "none"\nname = "truth"\ntitle = "Truth [bold]"\n'
        '[entry]\npredictions = "predictions"\n'
    )
    out = tmp_path / "out"
    words = ["evaluate", str(entry), "--capture", str(capture.root), "--out", str(out)]
    assert main(words) == 0
    captured = capsys.readouterr()
    assert "Truth [bold]" in captured.out
    assert "100.00" in captured.out
    assert str(out / "results.json") in captured.err
    assert "comparison.png" in captured.err
    assert main(["table", str(out), "--format", "md"]) == 0
    assert "100.00" in capsys.readouterr().out
    (entry / "predictions" / "tiny" / "000019.png").unlink()
    assert main([*words, "--overwrite"]) == 1
    assert "1 of 2 frames: 000019.png: does not exist" in capsys.readouterr().err


def test_what_is_named_next_can_be_given(
    make_capture: CaptureMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    from small_methods import write_submission

    capture = make_capture(frames=20, size=48)
    monkeypatch.chdir(tmp_path)
    images = {f"tiny/{frame:06d}.png": capture.frame(frame) for frame in (18, 19)}
    write_submission(Path("entry"), images)
    where = ["--capture", str(capture.root)]

    def follow(words: list[str], status: int = 0) -> list[str]:
        """Give a command; returns the words that it says come next."""
        assert main(words) == status
        found = re.findall("^next: hwp-bench (.+)$", capsys.readouterr().err, re.MULTILINE)
        return found[0].split() if found else []

    evaluate = follow(["check-method", "entry", *where])
    assert evaluate == ["evaluate", "entry", *where]
    assert follow([*evaluate, "-o", "out"]) == ["report", "out", "-o", "reports/out"]
    # The board takes results of suites alone.
    assert follow(["verify", "out", *where]) == []
    Path("entry/predictions/tiny/000019.png").unlink()
    check = follow([*evaluate, "-o", "out", "--overwrite"], 1)
    assert check == ["check-method", "entry", *where]
    assert follow(check, 1) == []


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_the_log_that_is_named_is_there(
    make_capture: CaptureMaker, tmp_path: Path, capsys, jobs: str
) -> None:
    from toy_method import write_toy_method

    method, out = write_toy_method(tmp_path / "toy"), tmp_path / "out"
    capture = make_capture(frames=20)
    words = ["evaluate", str(method), "--capture", str(capture.root), "--out", str(out)]
    assert main([*words, "--set", "fail=tiny", "--jobs", jobs]) == 1
    said = capsys.readouterr().err
    named = re.findall(r"\S+log\.txt", said.replace("\n", " "))
    assert named == [str(out / "captures" / "tiny" / "log.txt")]
    assert "no luck" in Path(named[0]).read_text()


def test_a_reader_that_stops_reading_is_no_traceback() -> None:
    command = f"{sys.executable} -m hwp_bench.cli.main list captures | head -n 1"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True)
    assert "Captures" in done.stdout
    assert "Traceback" not in done.stderr


def test_a_stopped_evaluation_leaves_no_process_behind(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    capture = make_capture(frames=20)
    method = tmp_path / "method"
    method.mkdir()
    pid_file = tmp_path / "pid"
    (method / "run.py").write_text(
        f"import os, time\nopen({str(pid_file)!r}, 'w').write(str(os.getpid()))\ntime.sleep(600)\n"
    )
    (method / "method.toml").write_text(
        'schema = "hwp-method/1"\ntraining = "none"\nname = "slow"\n'
        '[entry]\ncommand = ["{python}", "{method}/run.py"]\n'
    )
    words = ["evaluate", str(method), "--capture", str(capture.root), "--out", str(tmp_path / "o")]
    # The method tells its process by a file outside its own folder, which isolation forbids.
    words += ["--isolation", "none"]
    command = [sys.executable, "-m", "hwp_bench.cli.main", *words]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        while not (pid_file.is_file() and pid_file.read_text()):
            assert process.poll() is None
            time.sleep(0.05)
        process.terminate()
        _, errors = process.communicate()
    assert process.returncode == 130
    assert "stopped" in errors
    assert "Traceback" not in errors
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid_file.read_text()), 0)
