"""Diagnostics of a method are kept by name and within bounds. Oracle: the files that it wrote."""

from __future__ import annotations

from pathlib import Path

import pytest

from hwp_bench.evaluation import artifacts


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
