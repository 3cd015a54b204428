"""What commands say where a place, a file or an option is wrong. Oracle: the text, the disc."""

from __future__ import annotations

import argparse
import ast
import errno
import json
import os
import pickle
import re
import shutil
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from made_results import made_results
from small_captures import CaptureMaker
from synthetic_mano import mano_content

from hwp_bench.base.errors import BadInput, HwpError, MissingDependency, reason_of
from hwp_bench.base.files import atomic_write, cache_root
from hwp_bench.base.packages import PACKAGES, import_extra
from hwp_bench.cli.main import main
from hwp_bench.cli.program import whole_parser
from hwp_bench.hands.sources import load_mano
from hwp_bench.results import write_results
from wildghand.cli.main import command_tree


def test_the_reason_is_said_for_every_kind_of_error(tmp_path: Path) -> None:
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert reason_of(full) == "No space left on device"
    assert reason_of(OSError("of a library")) == "of a library"
    assert reason_of(OSError()) == "OSError"
    (tmp_path / "from").mkdir()
    (tmp_path / "from" / "a.png").write_text("x")

    def refuse(source: str, target: str) -> None:
        raise full

    with pytest.raises(shutil.Error) as error:
        shutil.copytree(tmp_path / "from", tmp_path / "to", copy_function=refuse)
    assert "No space left on device" in reason_of(error.value)


def test_a_full_disc_is_named_when_captures_are_published(
    make_capture: CaptureMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    root = make_capture(frames=20).root

    def refuse(source: object, target: object, **_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))

    monkeypatch.setattr("hwp_bench.commitments.publication.shutil.copyfile", refuse)
    assert main(["challenge", "publish", str(root), "-o", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    assert "No space left on device" in said
    assert "None" not in said
    assert not (tmp_path / "out").exists()


def test_a_cache_that_cannot_be_written_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("HWP_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises(HwpError, match="choose another cache folder with HWP_CACHE"):
        atomic_write(cache_root() / "x", "")
    with pytest.raises(HwpError) as error:
        atomic_write(tmp_path / "file" / "x", "")
    assert "HWP_CACHE" not in str(error.value)


def test_a_subject_is_painted_without_a_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hwp_bench.sim.scene_files import load_scene
    from hwp_bench.sim.subject.hand import kept, skin_material

    (tmp_path / "file").write_text("")
    monkeypatch.setenv("HWP_CACHE", str(tmp_path / "file" / "cache"))
    subject = load_scene("capture0").subject
    blank = skin_material(*(np.zeros((2, 2, 3)), np.zeros((2, 2)), np.zeros((2, 2))))
    template = SimpleNamespace(digest="of a template")
    hand: Any = SimpleNamespace(template=template, model=template, betas=np.zeros(10))
    assert kept(hand, subject, "test", lambda: blank) is blank


def test_an_unknown_perturbation_is_named_with_its_file(make_capture: CaptureMaker, capsys) -> None:
    root = make_capture(frames=12).root
    value = json.loads((root / "capture.json").read_text("utf-8"))
    value["perturbations"] = {"fog": None}
    (root / "capture.json").write_text(json.dumps(value), "utf-8")
    assert main(["data", "check", str(root)]) == 1
    said = capsys.readouterr().out
    assert f"error: {root / 'capture.json'}: perturbations: there is no perturbation 'fog'" in said


def test_a_seed_below_zero_is_refused_by_the_simulator(tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    assert main(["sim", "render", "capture0", "-o", str(out), "--seed", "-1"]) == 2
    assert "--seed: -1 is not from 0 to" in capsys.readouterr().err
    assert not out.exists()


def test_a_seed_below_zero_is_refused_by_a_comparison(tmp_path: Path, capsys) -> None:
    for name in ("a", "b"):
        made = made_results(name, lambda c, f, s: 20.0 + c)
        write_results(tmp_path / name / "results.json", made)
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "b"), "--seed", "-1"]) == 2
    assert "--seed: -1 is not from 0 to" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--author", "--reason", "--revises", "--link"])
@pytest.mark.parametrize("text", ["\x1b[2J", "two\nlines", "\u202egnp", "x" * 1001])
def test_a_submission_holds_lines_that_can_be_read(
    option: str, text: str, tmp_path: Path, capsys
) -> None:
    write_results(tmp_path / "R" / "results.json", made_results("a", lambda c, f, s: 20.0))
    out = tmp_path / "out"
    given = f"code=https://example.org/{text}" if option == "--link" else text
    words = ["leaderboard", "submit", str(tmp_path / "R"), "-o", str(out), option, given]
    assert main(words) != 0
    assert option in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize("action", [["build", "-o", "site"], ["show"]], ids=["build", "show"])
def test_a_board_of_no_sound_entry_is_refused(
    action: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "entries").mkdir()
    assert main(["leaderboard", *action, "--entries", "entries"]) == 2
    assert "holds no entry" in capsys.readouterr().err
    (tmp_path / "entries" / "a.json").write_text("{}")
    assert main(["leaderboard", *action, "--entries", "entries"]) == 2
    assert "holds no sound entry" in capsys.readouterr().err
    assert not (tmp_path / "site").exists()


@pytest.mark.parametrize("field", ["v_template", "weights", "kintree_table"])
def test_complex_numbers_of_a_hand_model_are_refused(field: str, tmp_path: Path) -> None:
    content = mano_content("right")
    content["shapedirs"] = content["shapedirs"][:, :, :10]
    content[field] = np.asarray(content[field]) + 1j
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(pickle.dumps(content))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(BadInput, match="not plain numbers"):
            load_mano(str(tmp_path), "right")


def test_the_sheet_is_explained_with_the_words_on_it() -> None:
    from hwp_bench.cli.data import _SHOW
    from hwp_bench.taxonomy import PERTURBATIONS, perturbation

    for name in PERTURBATIONS:
        assert f"{perturbation(name).short}: " in _SHOW


def test_an_import_names_options_of_a_fit_or_their_command() -> None:
    """`wildghand fit VIDEO` imports too. Oracle: its parser."""
    (commands,) = (
        action.choices
        for action in whole_parser("wildghand", command_tree())._actions
        if isinstance(action, argparse._SubParsersAction)
    )
    known, named = commands["fit"]._option_string_actions, 0
    folder = PACKAGES / "hwp_bench" / "importers"
    for path in (*sorted((folder / "video").glob("*.py")), folder / "shared" / "landmarks.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            targets = getattr(node, "targets", []) if isinstance(node, ast.Assign) else []
            names = {getattr(node, "arg", ""), *(getattr(one, "id", "") for one in targets)}
            if not isinstance(node, ast.Assign | ast.keyword) or "remedy" not in names:
                continue
            text = ast.unparse(node.value)
            for option in re.finditer(r"--[a-z-]+", text):
                named += 1
                command = "`hwp-bench data" in text[: option.start()]
                assert command or option.group() in known, f"{path.name}: {text}"
    assert named > 5


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "an_extra is missing here"),
        ("", "an_extra is missing here"),
        ("raise ImportError('libGL.so.1: cannot open')", "an_extra is installed.*libGL.so.1: cann"),
        ("import of_which_it_needs", "an_extra is installed.*'of_which_it_needs'"),
    ],
    ids=["no package", "no module in it", "a library", "a package it needs"],
)
def test_an_extra_that_fails_is_not_called_missing(
    content: str | None, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if content is not None:
        (tmp_path / "an_extra").mkdir()
        (tmp_path / "an_extra" / "__init__.py").write_text(content)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "an_extra", raising=False)
    with pytest.raises(MissingDependency, match=said) as caught:
        import_extra("an_extra.part", "view", "an_extra is missing here")
    assert "pip install 'hwp-bench[view]'" in str(caught.value)
    assert ("is missing here" in str(caught.value)) == (not content)
    monkeypatch.delitem(sys.modules, "an_extra", raising=False)
