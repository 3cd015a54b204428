"""Names of files that no UTF-8 is, or that steer a terminal. Oracle: exit status, output, files."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
from small_captures import CaptureMaker

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.images import read_rgb, write_image
from hwp_bench.capture import open_capture
from hwp_bench.capture.check import draw_hands
from hwp_bench.capture.schema import LARGEST
from hwp_bench.cli.main import main

ODD = os.fsdecode(b"a\xff\xfe")


@pytest.mark.parametrize(
    "words",
    [
        ["data", "check", ODD],
        ["evaluate", "plain", "--capture", "x", "-o", ODD],
        ["evaluate", "plain", "--capture", "x", "--set", f"level={ODD}"],
        [ODD],
    ],
)
def test_a_word_that_is_not_utf_8_is_one_message(
    words: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / ODD).mkdir()
    assert main(words) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "is not UTF-8" in said
    assert os.listdir(os.fsencode(tmp_path)) == [os.fsencode(ODD)]


def test_images_of_such_names_are_refused_and_none_of_another_is_written(tmp_path: Path) -> None:
    pixels = np.zeros((4, 4, 3), dtype=np.uint8)
    for act in (lambda p: write_image(p, pixels), read_rgb):
        with pytest.raises(UsageError, match="not UTF-8"):
            act(tmp_path / ODD / "a.png")
    assert not list(tmp_path.iterdir())


def test_names_of_stray_files_do_not_steer_the_terminal(
    make_capture: CaptureMaker, capsys: pytest.CaptureFixture[str]
) -> None:
    root = make_capture().root
    for name in (b"\x1b[2J\x1b]0;x\x07.png", b"\xff.png", b"a\nb", "\u202egnp".encode()):
        (root / "frames" / os.fsdecode(name)).write_text("x")
    main(["data", "check", str(root)])
    printed = capsys.readouterr()
    assert "4 further files" in printed.out
    assert not {"\x1b", "\x07", "\udcff", "\u202e"} & {*printed.out, *printed.err}
    assert "a\nb" not in printed.out


@pytest.mark.parametrize(("name", "value"), [("transl", 1e7), ("pose", 1e200), ("betas", 1e308)])
def test_hands_of_impossible_size_are_refused(
    make_capture: CaptureMaker, name: str, value: float, capsys: pytest.CaptureFixture[str]
) -> None:
    root = make_capture().root
    with np.load(root / "hands.npz") as file:
        arrays = {key: file[key] for key in file.files}
    arrays[f"right_{name}"][0] = value
    np.savez(root / "hands.npz", **arrays)
    with pytest.raises(
        BadInput, match=re.escape(f"right_{name}: holds a number beyond {LARGEST:g}")
    ):
        open_capture(root)
    assert main(["data", "show", str(root), "-o", str(root / "sheet.png")]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_what_is_no_place_is_not_drawn() -> None:
    image = np.zeros((8, 8, 3), dtype=np.uint8)
    points = np.full((21, 2), np.nan)
    points[3] = np.inf, -np.inf
    np.testing.assert_array_equal(draw_hands(image, {"right": points}), image)
