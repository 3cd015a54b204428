"""Folders between machines. Oracles: the folder itself; archives that were made to do harm."""

from __future__ import annotations

import io
import os
import zipfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.methods.contents import method_files
from hwp_bench.run.engine.ray import Parcel, folder_digest, pack, unpack

NAMES = st.text("abcxyz", min_size=1, max_size=3)
TREES = st.dictionaries(
    st.tuples(st.sampled_from(["", "p/", "p/q/"]), NAMES), st.binary(max_size=9)
)


def write_tree(root: Path, tree: dict[tuple[str, str], bytes]) -> Path:
    root.mkdir()
    for (folder, name), content in tree.items():
        path = root / f"{folder}f{name}"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return root


def content(root: Path) -> dict[str, bytes | None]:
    paths = root.rglob("*")
    return {str(p.relative_to(root)): p.read_bytes() if p.is_file() else None for p in paths}


def test_a_file_that_is_named_like_a_folder_of_git_arrives(tmp_path: Path) -> None:
    """Oracle: the digest of a method, which counts it."""
    root = write_tree(tmp_path / "a", {("", "x"): b"1"})
    (root / ".git").write_text("gitdir: ../.git/modules/a")
    unpack(pack(root), tmp_path / "b")
    assert method_files(tmp_path / "b") == method_files(root)


@settings(max_examples=40, deadline=None)
@given(TREES, TREES)
def test_a_folder_arrives_as_it_was_and_digests_tell_folders_apart(
    tmp_path_factory: pytest.TempPathFactory, one: dict, other: dict
) -> None:
    place = tmp_path_factory.mktemp("trees")
    first, second = write_tree(place / "one", one), write_tree(place / "other", other)
    parcel = pack(first)
    assert parcel.digest == folder_digest(first)
    unpack(parcel, place / "there")
    assert content(place / "there") == content(first)
    assert pack(place / "there") == parcel
    assert (folder_digest(second) == parcel.digest) == (content(first) == content(second))
    assert sorted(path.name for path in place.iterdir()) == ["one", "other", "there"]


def test_programs_stay_executable_and_rubbish_stays_behind(tmp_path: Path) -> None:
    root = write_tree(tmp_path / "a", {("", "x"): b"1", ("extra/", "y"): b"2"})
    (root / "fx").chmod(0o755)
    (root / "__pycache__").mkdir()
    (root / "__pycache__" / "m.pyc").write_bytes(b"3")
    unpack(pack(root, ("extra",)), tmp_path / "b")
    assert content(tmp_path / "b") == {"fx": b"1"}
    assert os.access(tmp_path / "b" / "fx", os.X_OK)
    before = folder_digest(tmp_path / "b")
    (tmp_path / "b" / "fx").chmod(0o644)
    assert folder_digest(tmp_path / "b") != before


@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_links_and_pipes_are_not_followed(tmp_path: Path, kind: str) -> None:
    root = write_tree(tmp_path / "a", {("", "x"): b"1"})
    if kind == "link":
        (root / "secret").symlink_to("/etc/hostname")
    else:
        os.mkfifo(root / "secret")
    with pytest.raises(BadInput, match="secret: is a link or not a plain file"):
        pack(root)


def harmful(name: str, **facts: int) -> Parcel:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", facts.get("compress", zipfile.ZIP_STORED)) as archive:
        info = zipfile.ZipInfo(name)
        info.compress_type = facts.get("compress", zipfile.ZIP_STORED)
        info.external_attr = facts.get("mode", 0o644) << 16
        archive.writestr(info, b"/etc/passwd")
    return Parcel("0" * 64, buffer.getvalue())


@pytest.mark.parametrize(
    ("parcel", "problem"),
    [
        (harmful("../out.txt"), "leads out of the folder"),
        (harmful("/tmp/out.txt"), "leads out of the folder"),
        (harmful("a/../../out.txt"), "leads out of the folder"),
        (harmful("a", compress=zipfile.ZIP_DEFLATED), "is compressed"),
        # Called a link by the archive: written as a plain file, and then it is not what it was.
        (harmful("a", mode=0o120777), "its digest is different"),
        (harmful("a"), "its digest is different"),
        (Parcel("0" * 64, b"PK"), "is damaged"),
    ],
)
def test_what_is_not_what_was_sent_leaves_nothing(
    tmp_path: Path, parcel: Parcel, problem: str
) -> None:
    target = tmp_path / "inner" / "there"
    with pytest.raises(BadInput, match=problem):
        unpack(parcel, target)
    assert list(tmp_path.rglob("*")) == [tmp_path / "inner"]


def test_replacing_is_asked_for_and_full_places_are_named(tmp_path: Path) -> None:
    new, old = write_tree(tmp_path / "new", {("", "x"): b"1"}), tmp_path / "old"
    write_tree(old, {("", "y"): b"2"})
    unpack(pack(new), old)
    assert content(old) == {"fy": b"2"}
    unpack(pack(new), old, replace=True)
    assert content(old) == {"fx": b"1"}
    (tmp_path / "file").touch()
    with pytest.raises(HwpError, match="cannot be written"):
        unpack(pack(new), tmp_path / "file" / "there")
