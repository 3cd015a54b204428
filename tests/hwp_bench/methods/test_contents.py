"""Digests of methods. Oracle: files that are changed, moved, or have nothing to say."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from hwp_bench.base.errors import BadInput, BadMethod
from hwp_bench.methods.contents import (
    digest_of,
    exposed_digest,
    method_files,
    refuse_links_out,
    unseen_folders,
)


def method_digest(root: Path) -> str:
    return digest_of(method_files(root))


def make_method(root: Path) -> Path:
    (root / "priors").mkdir(parents=True)
    (root / "method.toml").write_text("a = 1")
    (root / "priors" / "weights.safetensors").write_bytes(b"12345678")
    return root


def test_every_file_of_a_method_counts_whatever_it_ends_with(tmp_path: Path) -> None:
    root = make_method(tmp_path / "method")
    seen = {method_digest(root)}
    assert {method_digest(make_method(tmp_path / "elsewhere"))} == seen
    # The kinds of the audit, one without an ending, a hidden file and one in a hidden folder.
    endings = [
        *("sh", "so", "txt", "csv", "h5", "tflite", "ply"),
        *("spz", "msgpack", "cfg", "cpp", "cu", "html", "png"),
    ]
    names = [*(f"part.{ending}" for ending in endings), "run", ".env", ".conf/a", "deep/er/b"]
    for name in names:
        file = root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        for content in (b"one", b"two!"):
            file.write_bytes(content)
            seen.add(method_digest(root))
    assert len(seen) == 1 + 2 * len(names)
    file.rename(root / "deep" / "er" / "c")
    assert method_digest(root) not in seen


def test_what_a_method_cannot_see_does_not_count(tmp_path: Path) -> None:
    root = make_method(tmp_path / "method")
    first = method_digest(root)
    files = [".git/config.toml", "src/__pycache__/a.pyc", ".mypy_cache/x.json"]
    files += ["runs/mine/.lock", "runs/mine/predictions/000001.png"]
    for name in files:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    for name, schema in (("old/results.json", "results"), ("clip/capture.json", "capture")):
        (root / name).parent.mkdir()
        (root / name).write_text(f'{{"schema": "hwp-{schema}/1"}}')
    os.mkfifo(root / "pipe")
    assert method_digest(root) == first

    def unseen(**named: bool) -> list[str]:
        return [path.relative_to(root).as_posix() for path in unseen_folders(root, **named)]

    foreign = ["clip", "old", "runs/mine"]
    assert unseen() == [".git", ".mypy_cache", *foreign, "src/__pycache__"]
    assert unseen(ships=True) == foreign
    # What is compiled in an environment of Python stays, and a run in it does not.
    (root / "src" / "pyvenv.cfg").touch()
    (root / "src" / "run").mkdir()
    (root / "src" / "run" / ".lock").touch()
    assert unseen() == [".git", ".mypy_cache", *foreign, "src/run"]


def test_a_link_inside_counts_by_where_it_leads(tmp_path: Path) -> None:
    root = make_method(tmp_path / "method")
    (root / "other").write_text("other")
    digests = [method_digest(root)]
    for target in ("method.toml", "other", "priors"):
        (root / "link").unlink(missing_ok=True)
        (root / "link").symlink_to(target)
        refuse_links_out(root, ())
        digests.append(method_digest(root))
    assert len(set(digests)) == 4
    (root / "priors" / "weights.safetensors").write_bytes(b"changed!")
    assert method_digest(root) not in digests
    # The same folder at another place, with an absolute link to its own file, is the same method.
    (root / "link").unlink()
    (root / "link").symlink_to(root / "other")
    moved = root.rename(tmp_path / "moved")
    (moved / "link").unlink()
    (moved / "link").symlink_to(moved / "other")
    shutil.copytree(moved, tmp_path / "copied", symlinks=True)
    (tmp_path / "copied" / "link").unlink()
    (tmp_path / "copied" / "link").symlink_to(tmp_path / "copied" / "other")
    assert method_digest(tmp_path / "copied") == method_digest(moved)


def test_a_link_to_what_is_in_no_digest_is_refused(tmp_path: Path) -> None:
    root, outside = make_method(tmp_path / "method"), tmp_path / "outside"
    outside.mkdir()
    (outside / "weights.bin").write_bytes(b"1")
    (root / ".git").mkdir()
    (root / ".git" / "hook").write_text("1")
    (root / "dangling").symlink_to(tmp_path / "nowhere")
    (root / "round").symlink_to(root / "round")
    refuse_links_out(root, ())
    for target in (outside / "weights.bin", outside, root / ".git" / "hook"):
        (root / "link").symlink_to(target)
        with pytest.raises(BadMethod, match=r"link: is a link to .*not a part of"):
            refuse_links_out(root, ())
        (root / "link").unlink()
    (root / "link").symlink_to(outside / "weights.bin")
    refuse_links_out(root, [outside])
    (root / "link").unlink()
    # The Python of an environment always leads out.
    (root / "env" / "bin").mkdir(parents=True)
    (root / "env" / "pyvenv.cfg").touch()
    (root / "env" / "bin" / "python3").symlink_to("/bin/sh")
    refuse_links_out(root, ())


def test_too_much_for_a_digest_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = make_method(tmp_path / "method")
    monkeypatch.setattr("hwp_bench.methods.contents.MAX_FILES", 1)
    with pytest.raises(BadInput, match=r"more than 1 files or 64 GiB.* another folder"):
        method_digest(root)


def test_a_file_of_the_same_size_and_another_date_is_read_again(tmp_path: Path) -> None:
    file = tmp_path / "weights.pt"
    file.write_bytes(b"one")
    first = exposed_digest([file])
    file.write_bytes(b"two")
    os.utime(file, ns=(1, 1))
    assert exposed_digest([file]) != first


def test_what_is_exposed_counts_by_content_not_by_place(tmp_path: Path) -> None:
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "prior.json").write_text("{}")
        (tmp_path / name / ".hidden").mkdir()
    here, there = (exposed_digest([tmp_path / name]) for name in ("here", "there"))
    assert here == there
    (tmp_path / "there" / "prior.json").write_text("[]")
    assert exposed_digest([tmp_path / "there"]) != here
    assert exposed_digest([tmp_path / "nowhere"]) not in (here, exposed_digest([]))
