"""Keys of evaluations stay what they were; other machines. Oracle: keys of stored results."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from small_captures import CaptureMaker
from small_methods import write_submission

from hwp_bench.base.errors import HwpError
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.evaluation.capture_evaluation import (
    CaptureEvaluation,
    EvaluationSettings,
    evaluate_elsewhere,
)
from hwp_bench.methods.contract import Budget, RunSettings
from hwp_bench.run.engine.job import ignore_progress
from hwp_bench.run.sandbox.confinement import Confinement

#: A method, a capture and a split, of which only name and digests enter a key.
PARTS: dict[str, Any] = {
    "manifest": SimpleNamespace(name="mine", digest="a" * 64),
    "capture": SimpleNamespace(digest="b" * 64, free_view=None),
    "split": SimpleNamespace(digest="c" * 64),
}


def test_a_stored_result_is_found_again_under_its_key(tmp_path: Path) -> None:
    plain = CaptureEvaluation(**PARTS, settings=EvaluationSettings())
    assert plain.key == "2f36fe0ee3b9bd6656de5c7c55321d9d673644973fc1323db3c364247369df87"
    weights = tmp_path / "weights.json"
    weights.write_text("{}")
    full = CaptureEvaluation(
        **PARTS,
        settings=EvaluationSettings(
            run=RunSettings({"steps": 3, "rate": 0.5, "on": True}, 7, Budget(5.0, 9), "clean"),
            time_limit=1.0,
            confinement=Confinement(exposed=(weights,)),
        ),
        networks={"vgg": None, "alex": None},  # type: ignore[dict-item]
    )
    assert full.key == "f0f7518bae751f2dbf21fccb8bb0193b3d135bd66a777531e78e044aee26d2f6"


def test_what_is_exposed_and_not_on_a_machine_is_named(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    capture = make_capture("tiny", frames=20)
    entry = write_submission(tmp_path / "entry", {"tiny/000018.png": capture.frame(18)})
    shown = EvaluationSettings(confinement=Confinement(exposed=(tmp_path / "weights",)))
    same, inputs = (contiguous_split("tiny", 20), shown), {"method": entry, "capture": capture.root}
    with pytest.raises(HwpError, match="weights: --expose: is not on this machine"):
        evaluate_elsewhere(same, [], None, "k", inputs, tmp_path / "out", ignore_progress)
