"""Whatever is wrong with a call is said before a suite is rendered. Oracle: nothing is rendered."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
from small_captures import CaptureMaker

from hwp_bench.cli.main import main
from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
from hwp_bench.methods.contents import exposed_digest
from hwp_bench.methods.manifest import MethodManifest

METHOD = """
class Method:
    def __init__(self, settings, seed):
        self.level = float(settings["level"])
"""
MANIFEST = """
schema = "hwp-method/1"
training = "none"
name = "mine"
[entry]
ENTRY
[presets.default]
level = 0.5
[presets.default.light]
degree = 2
"""


class Rendered(Exception):
    """A suite would be rendered now."""


@pytest.fixture(autouse=True)
def no_rendering(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty cache, and a stop where rendering would begin."""

    def stop(*_: object, **__: object) -> None:
        raise Rendered

    monkeypatch.setenv("HWP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("hwp_bench.sim.produce.capture.RenderRequest.render", stop)
    monkeypatch.chdir(tmp_path)


def _method(
    folder: Path, entry: str = 'python = "mine:Method"', code: str = METHOD, more: str = ""
) -> Path:
    folder.mkdir()
    (folder / "mine.py").write_text(code)
    (folder / "method.toml").write_text(MANIFEST.replace("ENTRY", entry) + more)
    return folder


def test_a_field_goes_on_without_a_method_that_cannot_be_made(tmp_path: Path, capsys) -> None:
    _method(tmp_path / "mine")
    other = _method(tmp_path / "other", code="import no_such_package") / "method.toml"
    other.write_text(other.read_text().replace('name = "mine"', 'name = "other"'))
    with pytest.raises(Rendered):
        main(["evaluate", "mine", "other", "--suite", "smoke"])
    assert "cannot be made" in capsys.readouterr().err
    # None of these can be made.
    assert main(["evaluate", "other", "--suite", "smoke"]) == 1


WRONG = (
    (["--set", "levl=1"], 1, "Did you mean 'level'?"),
    (["--set", "light.degre=1"], 1, "Did you mean 'light.degree'?"),
    (["--preset", "fast"], 1, "has no preset 'fast'"),
    (["--expose", "nowhere"], 2, "nowhere: --expose: does not exist"),
    (["--out", "mine/mine.py"], 2, "--out: lies in the input METHOD"),
    (["--out", "file"], 1, "cannot be a results folder"),
    (["--out", "file/deeper"], 1, "cannot be a results folder"),
    (["--splits", "nowhere.json"], 1, "nowhere.json: does not exist"),
    (["--engine", "rai"], 2, "is not an engine"),
    (["--set", "level=bright"], 1, "mine cannot be made: ValueError: could not convert"),
)
SWITCH = "[switches.a]\nsettings_off = {level = 0.1}\n"


@pytest.mark.parametrize("command", ["evaluate", "ablate", "error-budget"])
def test_a_wrong_call_renders_nothing(command: str, tmp_path: Path, capsys) -> None:
    _method(tmp_path / "mine", more=SWITCH)
    (tmp_path / "file").write_text("mine")
    for words, status, problem in WRONG:
        assert main([command, "mine", "--suite", "smoke", *words]) == status
        assert problem in capsys.readouterr().err


@pytest.mark.parametrize(
    ("entry", "code", "problem"),
    [
        ('python = "mine:Method"', "import no_such_package", "cannot import mine"),
        ('python = "mine:Missing"', METHOD, "mine has no Missing"),
        ('command = ["no-such-program", "{request}"]', "", "no program 'no-such-program'"),
        ('predictions = "predictions"', "", "has predictions of no capture of this suite"),
    ],
)
def test_a_method_that_cannot_start_renders_nothing(
    entry: str, code: str, problem: str, tmp_path: Path, capsys
) -> None:
    _method(tmp_path / "mine", entry, code)
    assert main(["evaluate", "mine", "--suite", "smoke"]) == 1
    assert problem in capsys.readouterr().err


@pytest.mark.parametrize("command", ["evaluate", "ablate", "error-budget"])
def test_a_method_that_cannot_be_made_is_said_once_before_the_first_capture(
    command: str, make_capture: CaptureMaker, tmp_path: Path, capsys
) -> None:
    _method(tmp_path / "mine", more=SWITCH)
    captures = [make_capture(name).root for name in ("first", "second")]
    words = [command, "mine", "--set", "level=bright", "--out", "out", "--capture"]
    assert main([*words, *map(str, captures)]) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("mine cannot be made: ValueError: could not convert") == 1
    # The end of the traceback, with the line at fault.
    assert 'self.level = float(settings["level"])' in shown.err
    assert not list((tmp_path / "out").rglob("result*.json"))


def test_nothing_drawn_is_no_table(make_capture: CaptureMaker, tmp_path: Path, capsys) -> None:
    _method(tmp_path / "mine", code=METHOD + "    def fit(self, *_): raise OSError('no luck')\n")
    words = ["mine", "--out", "out", "--capture", str(make_capture("first").root)]
    assert main(["evaluate", *words]) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "failed: first: 2 of 2 frames: mine failed on first: OSError: no luck" in shown.err
    assert (tmp_path / "out" / "results.json").is_file()


def test_a_program_that_may_not_be_run_is_said_before_the_first_capture(
    make_capture: CaptureMaker, tmp_path: Path, capsys
) -> None:
    mine = _method(tmp_path / "mine", 'command = ["{method}/run.sh"]')
    words = ["evaluate", "mine", "--capture", str(make_capture("first").root)]
    assert main(words) == 1
    assert "there is no program '{method}/run.sh'" in capsys.readouterr().err
    (mine / "run.sh").write_text("#!/bin/sh\n")
    assert main(words) == 1
    assert "'{method}/run.sh' is not executable" in capsys.readouterr().err


def test_a_submission_that_is_not_filled_renders_nothing(tmp_path: Path, capsys) -> None:
    mine = _method(tmp_path / "mine", 'predictions = "predictions"', "")
    for name in ("capture0", "capture4"):
        (mine / "predictions" / name).mkdir(parents=True)
    assert main(["evaluate", "mine", "--suite", "smoke"]) == 1
    assert "has predictions of no capture of this suite" in capsys.readouterr().err
    (mine / "predictions" / "capture4" / "000027.png").touch()
    with pytest.raises(Rendered):
        main(["evaluate", "mine", "--suite", "smoke"])
    assert "no predictions of capture0: every frame" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["evaluate", "mine", "--seed", "1"], "a seed other than 0"),
        (["evaluate", "mine", "--seeds", "2"], "a seed other than 0"),
        (["evaluate", "mine", "--budget", "16", "--steps", "9"], "a limit of steps"),
        (["evaluate", "mine", "--set", "level=1"], "settings"),
        (["evaluate", "mine", "--train-on", "clean"], "an oracle"),
        (["error-budget", "mine"], "an oracle"),
    ],
)
def test_what_has_no_effect_on_pictures_is_refused(
    words: Sequence[str], name: str, tmp_path: Path, capsys
) -> None:
    picture = _method(tmp_path / "mine", 'predictions = "predictions"', "") / "predictions"
    picture = picture / "capture4" / "000027.png"
    picture.parent.mkdir(parents=True)
    picture.touch()
    assert main([*words, "--suite", "smoke"]) == 2
    assert f"drawn before: {name} would have no effect" in capsys.readouterr().err
    with pytest.raises(Rendered):
        main(["evaluate", "mine", "--suite", "smoke", "--budget", "16"])


def test_a_folder_that_another_run_writes_to_is_said_at_once(tmp_path: Path, capsys) -> None:
    from hwp_bench.base.folders import exclusive

    _method(tmp_path / "mine")
    with exclusive(tmp_path / "out"):
        assert main(["evaluate", "mine", "--suite", "smoke", "--out", "out"]) == 1
    assert "another run is writing here" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        ["evaluate", "mine", "--suite", "smoke"],
        ["evaluate", "mine", "--suite", "smoke", "--set", "level=1", "--set", "light.degree=3"],
        ["demo", "--methods", "mine"],
    ],
    ids=" ".join,
)
def test_a_sound_call_goes_on_to_render(words: Sequence[str], tmp_path: Path) -> None:
    _method(tmp_path / "mine")
    with pytest.raises(Rendered):
        main(words)


def test_what_is_exposed_is_found_from_another_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _method(tmp_path / "mine")
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "net.pth").write_text("mine")
    exposed: list[Path] = []

    def check(manifest: MethodManifest, settings: EvaluationSettings, *_: object, **__: object):
        exposed.extend(settings.confinement.exposed)
        raise Rendered

    monkeypatch.setattr("hwp_bench.evaluation.evaluate.check_call", check)
    with pytest.raises(Rendered):
        main(["evaluate", "mine", "--suite", "smoke", "--expose", "weights"])
    monkeypatch.chdir(tmp_path / "mine")
    assert exposed_digest(exposed) == exposed_digest([tmp_path / "weights"])


def test_a_name_like_none_of_a_method_without_a_list_is_said(tmp_path: Path, capsys) -> None:
    _method(tmp_path / "mine")
    with pytest.raises(Rendered):
        main(["evaluate", "mine", "--suite", "smoke", "--set", "wholly_other=1"])
    assert "wholly_other: mine does not list its settings" in capsys.readouterr().err
    # The same of a method that has no presets either.
    manifest = tmp_path / "mine" / "method.toml"
    manifest.write_text(manifest.read_text().partition("[presets")[0])
    code = METHOD.replace('float(settings["level"])', "0.5")
    (tmp_path / "mine" / "mine.py").write_text(code)
    with pytest.raises(Rendered):
        main(["evaluate", "mine", "--suite", "smoke", "--set", "wholly_other=1"])
    assert "wholly_other: mine does not list its settings" in capsys.readouterr().err


def test_a_wrong_truth_renders_nothing(tmp_path: Path, capsys) -> None:
    _method(tmp_path / "mine")
    assert main(["error-budget", "mine", "--suite", "smoke", "--truths", "posse"]) == 2
    assert "'posse' is not an estimate" in capsys.readouterr().err


def test_python_looks_ahead_too(make_capture: CaptureMaker, tmp_path: Path) -> None:
    import hwp_bench
    from hwp_bench.base.errors import BadMethod, MethodFailed, UsageError

    _method(tmp_path / "mine")
    with pytest.raises(BadMethod, match="Did you mean 'level'"):
        hwp_bench.evaluate("mine", "smoke", settings={"levl": 1})
    with pytest.raises(UsageError, match="is not one of perturbed"):
        hwp_bench.evaluate("mine", "smoke", frames="cleen")
    with pytest.raises(MethodFailed, match="mine cannot be made: ValueError"):
        hwp_bench.evaluate("mine", make_capture("first"), settings={"level": "bright"})
