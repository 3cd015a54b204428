"""The table by outline. Oracle: the truth as an entry, and entries that are drawn larger."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_results import drawn_results

from hwp_bench.base.errors import UsageError
from hwp_bench.capture import Capture
from hwp_bench.metrics.protocol import PSNR_CAP
from hwp_bench.report.requested_table import TableRequest, make_table
from hwp_bench.results import Results


def entry(capture: Capture, folder: Path, example: Results, grown: int) -> Path:
    """A result whose predictions are the hand over black, with some more pixels around it."""

    def draw(frame: int) -> np.ndarray:
        hand = (capture.scoring_mask(frame)[0] > 0).astype(np.uint8)
        around = cv2.dilate(hand, np.ones((3, 3), np.uint8), iterations=grown) if grown else hand
        skin = np.full_like(capture.frame(frame), 60)
        image = np.where(hand[..., None], capture.frame(frame), skin)
        return np.asarray(image * around[..., None])

    return drawn_results(capture, folder, example, draw)


def test_who_draws_larger_is_seen(
    make_painted: Callable[..., Capture], make_results: Callable[..., Results], tmp_path: Path
) -> None:
    capture = make_painted()
    folders = [
        entry(capture, tmp_path / name, make_results(name), grown)
        for name, grown in (("exact", 0), ("large", 4), ("larger", 8))
    ]
    table = make_table(TableRequest(folders, by="outline", captures=[capture.root]))
    rows = {row[0]: row[1:] for row in table.rows}
    exact, large, larger = rows["Exact"], rows["Large"], rows["Larger"]
    assert exact == (PSNR_CAP, 0.0, PSNR_CAP, pytest.approx(exact[3]))
    # In what the headline scores, the three are the same.
    assert exact[0] == large[0] == larger[0]
    assert 0.0 < large[1] < larger[1]
    assert exact[2] > large[2] > larger[2]


def test_it_needs_the_captures_and_every_method_s_predictions(
    make_painted: Callable[..., Capture], make_results: Callable[..., Results], tmp_path: Path
) -> None:
    capture = make_painted()
    kept = entry(capture, tmp_path / "kept", make_results("kept"), 0)
    lost = entry(capture, tmp_path / "lost", make_results("lost"), 0)
    for path in (lost / "captures").rglob("*.png"):
        path.unlink()
    with pytest.raises(UsageError, match="predictions of every method"):
        make_table(TableRequest([kept], by="outline"))
    with pytest.raises(UsageError, match="predictions of every method"):
        make_table(TableRequest([kept, lost], by="outline", captures=[capture.root]))
