"""Estimated severities and `wildghand judge`; oracle: what was done to the judgement or frame."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hwp_bench.capture import Capture
from hwp_bench.taxonomy import PERTURBATIONS
from wildghand.cli.main import main
from wildghand.prepass.assessment import CUES, estimated_severity, neutral_assessment


def test_every_perturbation_has_a_cue() -> None:
    assert {str(kind) for kind in PERTURBATIONS} == set(CUES)


@pytest.mark.parametrize("kind", list(CUES))
def test_levels_grow_with_their_cue_and_with_no_other(kind: str) -> None:
    neutral = neutral_assessment(np.arange(4), np.array([True, True, True, False]), (8, 8))
    cue, deviations = CUES[kind]
    changed: dict[str, Any] = {cue: deviations * np.array([4.0, 2.0, 40.0, 3.0])}
    judgement = dataclasses.replace(neutral, clean=np.array([0.9, 0.1, 0.1, 0.0]), **changed)
    levels = estimated_severity(judgement)
    # Clean, two levels, more than the most, not usable.
    assert levels.pop(kind).tolist() == [0, 2, 5, 0]
    assert all(not level.any() for level in levels.values())


def test_judge_writes_what_it_prints(
    make_painted: Callable[..., Capture], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = make_painted()
    out, picture = tmp_path / "judgement.json", tmp_path / "judgement.png"
    before = sorted((str(path), path.stat().st_mtime_ns) for path in capture.root.rglob("*"))
    words = ["judge", str(capture.root), "-o", str(out), "--picture", str(picture), "--json"]
    assert main(words) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads(out.read_text())
    assert printed["estimated"]
    assert len(printed["clean"]) == len(capture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    after = sorted((str(path), path.stat().st_mtime_ns) for path in capture.root.rglob("*"))
    assert after == before


def test_judge_names_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["judge", str(tmp_path)]) == 1
    assert str(tmp_path) in capsys.readouterr().err
