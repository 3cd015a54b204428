"""The catalogue against the paper's dataset table."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from hwp_bench.base.errors import BadInput
from hwp_bench.taxonomy import PERTURBATIONS, catalogue, check_severity, perturbation

PAPER = Path(__file__).resolve().parents[4] / "shared" / "paper" / "wildghand.tex"


def test_eleven_captures_with_13821_frames_four_single_seven_interacting() -> None:
    captures = catalogue().values()
    assert [entry.id for entry in captures] == [f"capture{i}" for i in range(11)]
    assert sum(entry.frame_count for entry in captures) == 13_821
    assert [entry.hands for entry in captures].count("single") == 4
    assert [entry.hands for entry in captures].count("interacting") == 7
    assert all(set(entry.perturbations) <= set(PERTURBATIONS) for entry in captures)


@pytest.mark.skipif(not PAPER.is_file(), reason="the paper is not here")
def test_every_row_equals_the_paper() -> None:
    row = re.compile(r"^\s*(\d+) & (Single|Interacting) & (.+?)\s*& (.+?) & (\d+) & (.*)\\\\", re.M)
    rows = row.findall(PAPER.read_text(encoding="utf-8"))
    assert len(rows) == 11
    for number, hands, action, device, frames, marks in rows:
        entry = catalogue()[f"capture{number}"]
        marked = tuple(
            name
            for name, cell in zip(PERTURBATIONS, marks.split("&"), strict=True)
            if "checkmark" in cell
        )
        assert (entry.hands, entry.action, entry.device) == (hands.lower(), action, device)
        assert (entry.frame_count, entry.perturbations) == (int(frames), marked)


def test_unknown_names_and_severities_are_refused_by_name() -> None:
    with pytest.raises(BadInput, match="hand_object_interaction, complex_poses"):
        perturbation("fog")
    assert check_severity([0, 5, 3], where="f", field="x") == (0, 5, 3)
    for bad in (6, -1, 2.5, True, "3"):
        with pytest.raises(BadInput, match="of frame 1"):
            check_severity([0, bad], where="f", field="x")  # type: ignore[list-item]
