"""Atomic files and folders, bounded JSON, paths that stay inside, and a disc that is full.

Oracles: the file system, and a limit of the system on the size of a file. OpenImageIO answers that
all is well when the last bytes of an image find no space."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import stat
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from hwp_bench.base.errors import BadInput, HwpError, UsageError
from hwp_bench.base.files import (
    atomic_folder,
    atomic_write,
    inside,
    read_json,
    refuse_other,
    sha256_json,
    write_json,
)
from hwp_bench.base.images import write_image


def test_a_file_is_replaced_whole_and_leaves_nothing_beside_it(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "file.txt"
    atomic_write(target, "first")
    atomic_write(target, b"second")
    assert target.read_bytes() == b"second"
    assert [item.name for item in target.parent.iterdir()] == ["file.txt"]


def test_a_write_that_fails_is_one_error_and_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "file.json"
    write_json(target, {"old": 1})
    with pytest.raises(ValueError, match="Out of range float"):
        write_json(target, {"new": float("nan")})
    assert read_json(target) == {"old": 1}
    with pytest.raises(HwpError, match="cannot be written"):
        atomic_write(target / "below a file", "x")


def test_a_folder_takes_its_name_only_when_the_block_ends_well(tmp_path: Path) -> None:
    target = tmp_path / "capture"
    with pytest.raises(RuntimeError), atomic_folder(target) as folder:
        (folder / "half").write_text("x")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    with atomic_folder(target) as folder:
        (folder / "whole").write_text("x")
        assert not target.exists()
    assert (target / "whole").is_file()
    assert [item.name for item in tmp_path.iterdir()] == ["capture"]


def test_a_full_folder_is_not_overwritten_unless_asked(tmp_path: Path) -> None:
    target = tmp_path / "capture"
    with atomic_folder(target) as folder:
        (folder / "old").write_text("x")
    with pytest.raises(UsageError, match="exists already"), atomic_folder(target):
        pass
    with atomic_folder(target, overwrite=True) as folder:
        (folder / "new").write_text("x")
    assert [item.name for item in target.iterdir()] == ["new"]


@pytest.mark.parametrize("kind", ["folder", "file"])
@pytest.mark.parametrize("overwrite", [False, True])
def test_what_appears_during_the_block_is_not_lost(
    kind: str, overwrite: bool, tmp_path: Path
) -> None:
    """Oracle: the second of two makers finds what the first has made, or replaces it if asked."""
    target = tmp_path / "made"
    refused = kind == "file" or not overwrite
    with contextlib.ExitStack() as stack:
        if refused:
            stack.enter_context(pytest.raises(UsageError, match="exists already"))
        folder = stack.enter_context(atomic_folder(target, overwrite=overwrite))
        (folder / "second").write_text("x")
        if kind == "folder":
            with atomic_folder(target) as other:
                (other / "first").write_text("x")
        else:
            target.write_text("first")
    assert [item.name for item in tmp_path.iterdir()] == ["made"]
    if kind == "file":
        assert target.read_text() == "first"
    else:
        names = [item.name for item in target.iterdir()]
        assert names == (["first"] if refused else ["second"])


def test_an_empty_folder_is_filled_and_a_link_stays_one(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    with atomic_folder(tmp_path / "link") as folder:
        (folder / "whole").write_text("x")
    assert (tmp_path / "link").is_symlink()
    assert [item.name for item in (tmp_path / "real").iterdir()] == ["whole"]
    assert len(list(tmp_path.iterdir())) == 2


def test_many_makers_of_one_folder_end_with_one_that_is_whole(tmp_path: Path) -> None:
    """Oracle: without `overwrite` exactly one maker succeeds, and its content is what stays."""
    # Threads that wait for ever would outlast the time limit of a test, which ends the main one.
    target, start = tmp_path / "made", threading.Barrier(8, timeout=300.0)

    def make(number: int) -> bool:
        try:
            with atomic_folder(target) as folder:
                (folder / str(number)).write_text("x")
                start.wait()
        except UsageError:
            return False
        return True

    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(make, range(8)))
    assert made.count(True) == 1
    assert [item.name for item in target.iterdir()] == [str(made.index(True))]
    assert list(tmp_path.iterdir()) == [target]


def test_a_refusal_names_the_option_where_there_is_one(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with (
        pytest.raises(UsageError, match="or replace it with --overwrite") as caught,
        atomic_folder(tmp_path, flag="--overwrite"),
    ):
        pass
    with pytest.raises(UsageError) as plain, atomic_folder(tmp_path):
        pass
    assert "--" not in str(plain.value).replace(str(tmp_path), "")
    assert str(tmp_path) in str(caught.value)
    # A folder replaces no file, with the option or without.
    for overwrite in (False, True):
        with (
            pytest.raises(UsageError, match=r"exists already\. Choose another place\.$"),
            atomic_folder(tmp_path / "file", overwrite=overwrite, flag="--overwrite"),
        ):
            pass


@pytest.mark.parametrize(
    ("umask", "file", "folder"), [(0o022, 0o644, 0o755), (0o027, 0o640, 0o750)]
)
def test_outputs_have_the_modes_that_the_umask_gives(
    umask: int, file: int, folder: int, tmp_path: Path
) -> None:
    # In a process of its own, because a umask belongs to a whole process.
    script = f"""
import os
os.umask({umask})
from pathlib import Path
import numpy as np
from hwp_bench.base.files import atomic_folder, atomic_write, write_json
from hwp_bench.base.images import write_image
from hwp_bench.run.engine.ray import pack, unpack
root = Path({str(tmp_path)!r})
with atomic_folder(root / "made") as made:
    atomic_write(made / "text", "x")
    write_json(made / "value.json", 1)
    write_image(made / "image.png", np.zeros((2, 2, 3), np.uint8))
unpack(pack(root / "made"), root / "sent")
"""
    subprocess.run([sys.executable, "-c", script], check=True)
    for path in sorted(tmp_path.rglob("*")):
        assert path.stat().st_mode & 0o777 == (folder if path.is_dir() else file), path


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("{", "is not valid JSON"),
        ('{"a": NaN}', "NaN is not a JSON number"),
        ("[" * 100_000, "nested too deeply"),
        ("[" * 200 + "]" * 200, "nested too deeply"),
        ('{"a":' * 150 + "1" + "}" * 150, "nested too deeply"),
        ('{"a": 1e999}', "1e999 is too large a number"),
        ('{"a": -1e999}', "-1e999 is too large"),
        ('{"a": ' + "9" * 5000 + "}", "is too large a number"),
        ('{"a": 9223372036854775809}', "is too large a number"),
        ('"' + "x" * 300 + '"', "more than the 200 bytes"),
        (b"\xff\xfe{", "is not UTF-8"),
        ('{"fps": 30, "id": "a", "fps": 5}', "names 'fps' twice in one object. .* keep one"),
        ('[{"a": {"b": 1, "b": 1}}]', "names 'b' twice"),
        ('{"a": 1, "\\u0061": 1}', "names 'a' twice"),
        ('{"\x7f": 1, "\x7f": 1}', r"names '\?' twice"),
    ],
)
def test_damaged_json_is_named(tmp_path: Path, text: str | bytes, problem: str) -> None:
    path = tmp_path / "file.json"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    limit = 200 if "more than" in problem else 10**7
    with pytest.raises(BadInput, match=problem) as caught:
        read_json(path, max_bytes=limit)
    assert str(path) in str(caught.value)


def test_missing_json_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="does not exist"):
        read_json(tmp_path / "none.json")


@pytest.mark.parametrize("path", ["/etc/passwd", "../up", "a/../../up", "link/file"])
def test_paths_out_of_a_folder_are_refused(tmp_path: Path, path: str) -> None:
    root = tmp_path / "root"
    root.mkdir()
    (root / "link").symlink_to(tmp_path)
    with pytest.raises(BadInput, match="leads out of the folder"):
        inside(root, path)
    with pytest.raises(BadInput, match="holds a zero character"):
        inside(root, "a\0b")
    assert inside(root, "a/../b") == root / "b"


def test_json_digest_ignores_the_order_of_keys_only() -> None:
    assert sha256_json({"a": 1, "b": [1, 2]}) == sha256_json({"b": [1, 2], "a": 1})
    assert sha256_json({"a": 1, "b": [1, 2]}) != sha256_json({"a": 1, "b": [2, 1]})
    assert len(sha256_json(json.loads("{}"))) == 64


def test_json_of_ordinary_depth_and_size_is_read(tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    value = {"a": [[[1.5, -(2**63), None, True]]], "b": "\u202e"}
    path.write_text(json.dumps(value))
    assert read_json(path) == value


def test_pipes_devices_and_folders_are_not_waited_for(tmp_path: Path) -> None:
    import os

    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name in ("pipe", "zero"):
        with pytest.raises(BadInput, match="is not a regular file"):
            read_json(tmp_path / name)
    with pytest.raises(BadInput, match="cannot be read"):
        read_json(tmp_path)


@pytest.mark.parametrize("text", ['{"a": "\\ud800"}', '{"\\uDCFF": 1}', '["\\ude00\\ud83d"]'])
def test_halves_of_surrogate_pairs_are_refused(tmp_path: Path, text: str) -> None:
    """Oracle: UTF-8 itself; Python's JSON lets them through, and every output fails on them."""
    file = tmp_path / "file.json"
    file.write_text(text)
    with pytest.raises(BadInput, match="holds text that is not Unicode"):
        read_json(file)
    file.write_text('"\\ud83d\\ude00"')
    assert read_json(file) == "\U0001f600"


def test_one_of_many_that_write_a_new_file_at_once_has_it(tmp_path: Path) -> None:
    """Threads that start together: one is told that it has written, and its content is there."""
    target, barrier = tmp_path / "file", threading.Barrier(8)
    refusals: list[str] = []

    def write(number: int) -> bool:
        barrier.wait()
        try:
            atomic_write(target, str(number), overwrite=False, flag="--overwrite")
        except UsageError as error:
            refusals.append(str(error))
            return False
        return True

    with ThreadPoolExecutor(8) as pool:
        wrote = list(pool.map(write, range(8)))
    assert sum(wrote) == 1
    assert len(refusals) == 7
    assert all("exists already" in said and "--overwrite" in said for said in refusals)
    assert target.read_text() == str(wrote.index(True))
    assert list(tmp_path.iterdir()) == [target]


def test_a_new_file_is_exclusive_where_there_are_no_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def link(*_: object) -> None:
        raise PermissionError(errno.EPERM, "no links here")

    monkeypatch.setattr(os, "link", link)
    target = atomic_write(tmp_path / "file", "first", overwrite=False)
    with pytest.raises(UsageError, match="exists already"):
        atomic_write(target, "second", overwrite=False)
    assert target.read_text() == "first"
    atomic_write(target, "third")
    assert target.read_text() == "third"
    assert list(tmp_path.iterdir()) == [target]


WRITE = """
import resource, signal, sys
import numpy as np
from hwp_bench.base.errors import HwpError
from hwp_bench.base.images import write_image
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
_, most = resource.getrlimit(resource.RLIMIT_FSIZE)
for ending in ("png", "jpg", "bmp"):
    for limit in (0, 1, 1000, 4000):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, most))
        try:
            write_image(f"{sys.argv[1]}/{limit}.{ending}", noise)
        except HwpError as error:
            print(error)
"""


def test_an_image_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", WRITE, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 12
    assert all("cannot be written" in line for line in lines)
    assert list(tmp_path.iterdir()) == []


def test_a_mounted_volume_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    monkeypatch.setattr("os.path.ismount", lambda path: Path(path) == out)
    with pytest.raises(UsageError, match="Name a folder inside"), atomic_folder(out):
        pytest.fail("the work began")
    with pytest.raises(UsageError, match="mounted"):
        refuse_other(out, "a capture", lambda folder: True)


def test_a_pipe_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "out").symlink_to("pipe")
    for name in ("pipe", "out"):
        with pytest.raises(UsageError, match="a device or a pipe"):
            atomic_write(tmp_path / name, "x")
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)
    assert (tmp_path / "out").is_symlink()


def stop(*given: object) -> None:
    raise KeyboardInterrupt


def test_an_interrupted_write_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "replace", stop)
    with pytest.raises(KeyboardInterrupt):
        atomic_write(tmp_path / "a.txt", "x")
    with pytest.raises(KeyboardInterrupt):
        write_image(tmp_path / "a.png", np.zeros((4, 4, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []
