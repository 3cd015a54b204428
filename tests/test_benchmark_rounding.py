"""The comparison of two renderings. Oracle: the values that were changed."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import pytest
from small_captures import CaptureMaker

from benchmarks.rounding import Difference, captures


def test_values_that_were_changed_are_counted(make_capture: CaptureMaker, tmp_path: Path) -> None:
    old = make_capture("one", frames=10, size=32, perturbations={}).root
    new = tmp_path / "captures" / "new"
    shutil.copytree(old, new)
    same = Difference.of(old, new)
    assert same.pictures == len(list(old.rglob("*.png")))
    assert (same.other_pictures, same.other_values, same.most) == (0, 0, 0)
    file = sorted((new / "frames").iterdir())[3]
    picture = cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(int)
    picture[5, 6, 0] += 3 if picture[5, 6, 0] < 128 else -3
    picture[7, 8, 1] += 1 if picture[7, 8, 1] < 128 else -1
    cv2.imwrite(str(file), picture)
    assert Difference.of(old, new) == same._replace(other_pictures=1, other_values=2, most=3)
    file.unlink()
    with pytest.raises(SystemExit, match="the same pictures"):
        Difference.of(old, new)


def test_captures_are_found_in_a_folder(make_capture: CaptureMaker) -> None:
    root = make_capture("one", frames=10, size=32, perturbations={}).root
    for folder in (root, root.parent):
        assert [capture.root for _, capture in captures(folder)] == [root]
