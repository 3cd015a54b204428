"""Digests of methods. Oracle: files that are changed, moved, or have nothing to say."""

from __future__ import annotations

import os
from pathlib import Path

from hwp_bench.methods.contents import exposed_digest, method_digest


def make_method(root: Path) -> Path:
    (root / "priors").mkdir(parents=True)
    (root / "method.toml").write_text("a = 1")
    (root / "priors" / "weights.safetensors").write_bytes(b"12345678")
    return root


def test_weights_belong_to_a_method_as_its_code_does(tmp_path: Path) -> None:
    root = make_method(tmp_path / "method")
    first = method_digest(root)
    assert method_digest(make_method(tmp_path / "elsewhere")) == first
    (root / "log.txt").write_text("a note")
    (root / ".git").mkdir()
    (root / ".git" / "config.toml").write_text("b = 2")
    (root / "link.py").symlink_to(root / "method.toml")
    assert method_digest(root) == first
    weights = root / "priors" / "weights.safetensors"
    weights.write_bytes(b"12345679")
    assert method_digest(root) != first


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
    here, there = (exposed_digest([tmp_path / name]) for name in ("here", "there"))
    assert here == there
    (tmp_path / "there" / "prior.json").write_text("[]")
    assert exposed_digest([tmp_path / "there"]) != here
    assert exposed_digest([tmp_path / "nowhere"]) not in (here, exposed_digest([]))
