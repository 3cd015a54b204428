"""The table by novelty. Oracle: pooled errors by hand, and the truth as an entry."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from drawn_results import drawn_results

from hwp_bench.analysis.novelty import Novelty
from hwp_bench.base.errors import UsageError
from hwp_bench.capture import Capture
from hwp_bench.metrics.protocol import PSNR_CAP
from hwp_bench.report.novelty_table import CLASSES, classes_of
from hwp_bench.report.requested_table import TableRequest, make_table
from hwp_bench.results import Results


def test_classes_are_those_of_the_edges() -> None:
    angle = np.array([[0.0, 5.0, 10.0, 39.9, 60.0, 180.0, np.nan]])
    seen = np.array([[1.0, 0.5, 0.2, 0.05, 0.01, 0.0, np.nan]])
    found = classes_of(Novelty(0, angle, seen), np.ones((1, 7), dtype=bool))
    names = [[CLASSES[place][1] for place in row] for row in found]
    assert names[0] == [
        "below 5°", "5° to 10°", "10° to 20°", "20° to 40°", "above 40°", "never seen",
        "off the posed hand",
    ]  # fmt: skip
    assert names[1] == [
        "in more than 50 %", "in 20 to 50 %", "in 5 to 20 %", "in 5 % or less", "in 5 % or less",
        "never", "off the posed hand",
    ]  # fmt: skip


def test_errors_are_pooled_by_class(
    make_painted: Callable[..., Capture], make_results: Callable[..., Results], tmp_path: Path
) -> None:
    capture = make_painted()
    perfect = drawn_results(capture, tmp_path / "a", make_results("perfect"), capture.frame)

    def off_by_20(frame: int) -> np.ndarray:
        image = capture.frame(frame)
        return (image + (image < 128) * 20 - (image >= 128) * 20).astype(np.uint8)

    off = drawn_results(capture, tmp_path / "b", make_results("off"), off_by_20)
    table = make_table(TableRequest([perfect, off], by="novelty", captures=[capture.root]))
    for what in dict.fromkeys(name for name, _ in CLASSES):
        rows = [row for row in table.rows if row[0] == what]
        for method, psnr in (("Perfect", PSNR_CAP), ("Off", -20 * np.log10(20 / 255))):
            mine = [row for row in rows if row[2] == method]
            assert sum(row[3] for row in mine) == pytest.approx(100.0)
            # Every pixel is off by as much, so every class has the same score.
            for row in mine:
                assert row[5] == pytest.approx(psnr, abs=1e-6)
        shares = [row[4] for row in rows if row[2] == "Off"]
        assert sum(shares) == pytest.approx(100.0)


def test_it_needs_captures_and_predictions(
    make_painted: Callable[..., Capture], make_results: Callable[..., Results], tmp_path: Path
) -> None:
    capture = make_painted()
    folder = drawn_results(capture, tmp_path / "a", make_results("perfect"), capture.frame)
    with pytest.raises(UsageError, match="none of these captures"):
        make_table(TableRequest([folder], by="novelty"))
