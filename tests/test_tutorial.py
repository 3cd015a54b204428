"""The tutorial for methods runs as it stands. Oracles: exit statuses, templates, and scores."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from textwrap import indent

import pytest

from hwp_bench.base.packages import data_folder
from hwp_bench.capture import Capture
from hwp_bench.cli.main import main
from hwp_bench.results import read_results

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "tutorial-method.md").read_text("utf-8")
#: These take minutes: they are only parsed (`test_docs.py`).
LONG = ("--suite mini", "runs/compare")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)


def test_code_is_that_of_the_templates() -> None:
    files = [path.read_text("utf-8") for path in data_folder("templates").glob("*/*.*")]
    code = [*blocks("python"), *blocks("toml")]
    assert len(code) == 4
    for block in code:
        levels = [indent(block, " " * 4 * level) for level in range(3)]
        assert any(text in file for file in files for text in levels), block


@pytest.mark.slow
@pytest.mark.usefixtures("machine_code")
def test_commands_run_in_their_order(
    make_painted: Callable[[str], Capture], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lines = [line for block in blocks("sh") for line in block.splitlines()]
    for line in lines:
        if not any(text in line for text in LONG):
            # A painted capture takes the place of the suite, which is rendered for half a minute.
            line = line.replace("--suite smoke", f"--capture {make_painted('right').root}")
            program, *words = shlex.split(line)
            if program == "python":
                subprocess.run([sys.executable, *words], check=True)
            else:
                assert program == "hwp-bench"
                assert main(words) == 0, line
    # A mesh in one colour a vertex is nearer to the frames than one colour for all.
    mean, mesh = (
        read_results(tmp_path / "runs" / "both" / name / "seed-0").captures[0].frames
        for name in ("my_method", "my_mesh")
    )
    for one, other in zip(mean, mesh, strict=True):
        assert other.scores["oriented_distance"] < one.scores["oriented_distance"]
        assert 15.0 < other.scores["psnr"] < 40.0
