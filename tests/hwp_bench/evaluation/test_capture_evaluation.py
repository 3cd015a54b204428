"""Keys of evaluations stay what they were. Oracle: keys that earlier versions stored in results."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from hwp_bench.evaluation.capture_evaluation import CaptureEvaluation, EvaluationSettings
from hwp_bench.methods.contract import Budget, RunSettings
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
