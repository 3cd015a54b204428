"""Diagnostics of a method are kept by name and within bounds. Oracle: the files that it wrote."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from hwp_bench.evaluation import artifacts
from hwp_bench.evaluation.scoring import read_prediction


def test_named_files_are_kept_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = tmp_path / "source", tmp_path / "target"
    (source / "weights").mkdir(parents=True)
    (source / "right-temporal.json").write_text("{}")
    (source / "weights" / "000001.png").write_bytes(b"12345")
    (source / "weights" / "000002.png").write_bytes(b"12345")
    (source / "program.sh").write_text("echo")
    secret = tmp_path / "secret"
    secret.write_text("secret")
    (source / "left-temporal.json").symlink_to(secret)
    monkeypatch.setattr(artifacts, "MAX_DIAGNOSTICS", 7)
    artifacts.keep_diagnostics(source, target)
    kept = sorted(str(path.relative_to(target)) for path in target.rglob("*") if path.is_file())
    assert kept == ["right-temporal.json", "weights/000001.png"]
    artifacts.keep_diagnostics(tmp_path / "absent", target)
    assert not target.exists()


def test_files_of_holes_are_not_copied_whole(tmp_path: Path) -> None:
    """Three gigabytes that take no room in the output take none in the results either."""
    source, kept = tmp_path / "source", tmp_path / "kept"
    source.mkdir()
    (source / "000001.png").write_bytes(b"12345")
    for name in ("000002.png", "log.txt"):
        (source / name).touch()
        os.truncate(source / name, 3 << 30)
    artifacts.keep_predictions(kept, source, [1, 2, 3])
    artifacts.keep_log(source / "log.txt", kept / "log.txt")
    facts = {path.name: path.stat() for path in kept.iterdir()}
    assert sorted(facts) == ["000001.png", "000002.png", "log.txt"]
    assert (kept / "000001.png").read_bytes() == b"12345"
    assert facts["log.txt"].st_size < 2 << 20
    assert sum(one.st_blocks for one in facts.values()) * 512 < 2 << 20
    # It fails as the file itself did, so that a verification agrees.
    before, after = (read_prediction(folder, 2, (8, 8)).failure for folder in (source, kept))
    assert before == after == "000002.png: is larger than any image may be"
