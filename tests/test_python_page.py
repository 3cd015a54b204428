"""The code of docs/python.md runs as it stands. Oracle: the methods' own scores."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

PAGE = Path(__file__).resolve().parents[1] / "docs" / "python.md"


@pytest.mark.slow
@pytest.mark.usefixtures("machine_code")
def test_the_code_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    lines = [line for line in code.splitlines() if line and not line.startswith("#")]
    assert len(lines) <= 20
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(code, str(PAGE), "exec"), names)
    assert names["image"].shape == (96, 96, 4)
    # A hand that is drawn where it is scores far above black.
    black = names["hwp_bench"].score(0.0 * names["image"][:, :, :3], names["frame"], names["mask"])
    assert names["scores"]["psnr"] > black["psnr"] + 3.0
    assert names["same"].steps == names["avatar"].steps == 60
    assert "right" in repr(names["avatar"])
    assert names["gaussians"].means.shape[-1] == 3
