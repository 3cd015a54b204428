"""What a check says of perturbations: unknown is not none."""

from __future__ import annotations

from dataclasses import replace

import pytest
from small_captures import CaptureMaker

from hwp_bench.capture.check import check_capture
from hwp_bench.cli.main import main


@pytest.mark.parametrize(
    ("declared", "said"),
    [({}, "unknown"), ({"motion_blur": None}, "motion_blur unknown"), (None, "motion_blur 5")],
)
def test_frames_of_unknown_perturbations_are_unknown(
    declared, said: str, make_capture: CaptureMaker, capsys
) -> None:
    capture = make_capture(perturbations=declared)
    assert main(["data", "check", str(capture.root)]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if "perturbed_frames" in line)
    assert row.split(maxsplit=1)[1].strip() == said
    value = check_capture(capture.root).facts["perturbed_frames"]
    assert value == {"unknown": None, "motion_blur unknown": {"motion_blur": None}}.get(
        said, {"motion_blur": 5}
    )


def test_a_simulated_capture_without_effects_has_none(make_capture: CaptureMaker) -> None:
    from hwp_bench.capture.check import _perturbed_frames

    info = make_capture(perturbations={}).info
    assert _perturbed_frames(replace(info, source={"kind": "simulated"})) == {}
