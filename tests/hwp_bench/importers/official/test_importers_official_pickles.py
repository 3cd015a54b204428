"""Pickles of the official release are untrusted. Oracle: what the payload would have done."""

from __future__ import annotations

import builtins
import os
import pickle
import subprocess
from pathlib import Path
from typing import Any

import pytest
import torch

from hwp_bench.base.errors import BadInput, UnsafePickle
from hwp_bench.cli.main import main
from hwp_bench.importers.official.records import find_file, find_folders, read_records


def read(folder: Path) -> Any:
    return read_records(find_folders(folder)[0])


class Payload:
    """Pickles as a call."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


def test_pickles_that_ask_for_code_are_refused_by_name(tmp_path: Path) -> None:
    folder = tmp_path / "capture1_subsample2_single"
    folder.mkdir()
    trace = tmp_path / "trace"
    for name, payload in {
        "posix.system": Payload(os.system, f"touch {trace}"),
        "builtins.eval": Payload(builtins.eval, f"open({str(trace)!r}, 'w')"),
        "subprocess.Popen": Payload(subprocess.Popen, ["touch", str(trace)]),
        "builtins.getattr": Payload(builtins.getattr, Payload(dict), "fromkeys"),
        "torch._utils._rebuild_tensor_v2": torch.zeros(1, 48),
    }.items():
        rows = [{"img_path": "0.png", "mano_pose_right": payload}]
        (folder / "output.pkl").write_bytes(pickle.dumps(rows))
        with pytest.raises(UnsafePickle) as caught:
            read(folder)
        assert caught.value.field.startswith(name.rsplit(".", 1)[0])
        assert main(["data", "import", "wildghand", str(folder), "-o", str(tmp_path / "c")]) == 1
    assert not trace.exists()
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize("raw", [b"", b"garbage", b"\x80\x05]\x94(", b"(lp0\n" * 2000])
def test_damaged_pickles_are_one_line(tmp_path: Path, raw: bytes, capsys) -> None:
    folder = tmp_path / "capture1_subsample2_single"
    folder.mkdir()
    (folder / "output.pkl").write_bytes(raw)
    assert main(["data", "import", "wildghand", str(folder), "-o", str(tmp_path / "c")]) == 1
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    assert "output.pkl" in errors


def test_of_files_with_one_name_the_path_decides(tmp_path: Path) -> None:
    """As images and masks that are called alike."""
    for folder in (tmp_path, tmp_path / "masks"):
        folder.mkdir(exist_ok=True)
        (folder / "0001.png").write_bytes(b"x")
    for name, place in (("/a/masks/0001.png", "masks/0001.png"), ("/a/0001.png", "0001.png")):
        assert find_file(tmp_path, name, where=tmp_path, field="f") == tmp_path / place


def test_paths_in_pickles_never_leave_the_folder(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    (folder / "clip").mkdir(parents=True)
    (tmp_path / "1.png").write_bytes(b"x")
    (folder / "clip" / "2.png").write_bytes(b"x")
    assert find_file(folder, "/a/clip/2.png", where=folder, field="f") == folder / "clip" / "2.png"
    for name in ("../1.png", "/../1.png", str(tmp_path / "1.png"), "..\\1.png", "", "/"):
        with pytest.raises(BadInput):
            find_file(folder, name, where=folder, field="f")
