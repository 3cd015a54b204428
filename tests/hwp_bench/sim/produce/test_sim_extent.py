"""Numbers of frames and sizes that no memory holds. Oracle: the bounds that render states."""

from __future__ import annotations

import pytest

from hwp_bench.cli.main import main


@pytest.mark.parametrize(
    ("option", "value"),
    [("--frames", "1" * 60), ("--frames", "100001"), ("--frames", "-1"), ("--size", "9" * 30)],
)
@pytest.mark.parametrize("action", ["plan", "render"])
def test_what_no_memory_holds_is_one_message(
    action: str, option: str, value: str, capsys: pytest.CaptureFixture[str],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:  # fmt: skip
    words = ["sim", action, "capture0", f"{option}={value}"]
    if action == "render":
        words += ["-o", str(tmp_path_factory.mktemp("out") / "capture")]
    assert main(words) == 2
    assert "is not in" in capsys.readouterr().err
