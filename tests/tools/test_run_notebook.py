"""The notebooks of the docs run, and are small enough to be read. Oracles: their cells, Pillow."""

from __future__ import annotations

import base64
import copy
import io
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import hwp_bench

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
#: Most bytes of a notebook with what its cells have shown.
MOST = 200_000

sys.path.append(str(ROOT / "tools"))
from run_notebook import code_cells, run_cell, run_notebook  # noqa: E402


def test_a_cell_gives_what_it_prints_and_its_last_value() -> None:
    names: dict[str, object] = {}
    assert run_cell("x = 2\nprint('two')", names, "one") == ("two\n", None)
    assert run_cell("y = 3\nx * y", names, "two") == ("", 6)
    assert run_cell("# nothing", names, "three") == ("", None)
    with pytest.raises(ZeroDivisionError):
        run_cell("1 / 0", names, "four")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_read_by_people(path: Path) -> None:
    assert path.stat().st_size < MOST
    notebook = json.loads(path.read_text("utf-8"))
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
    text = [cell for cell in notebook["cells"] if cell["cell_type"] == "markdown"]
    assert len(text) >= len(list(code_cells(notebook))) / 2
    for cell in code_cells(notebook):
        source = "".join(cell["source"])
        assert max(map(len, source.splitlines())) <= 100
        # What is stored is what this code has shown.
        assert cell["execution_count"], source
    stored = [out for cell in code_cells(notebook) for out in cell["outputs"]]
    assert not [out for out in stored if out["output_type"] == "error"]
    assert "/tmp" not in json.dumps(stored)
    assert "/work" not in json.dumps(stored)


@pytest.mark.slow
@pytest.mark.usefixtures("machine_code")
def test_the_notebook_of_the_avatar_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = ROOT / "docs" / "notebooks" / "avatar.ipynb"
    stored = json.loads(path.read_text("utf-8"))
    ran = copy.deepcopy(stored)
    run_notebook(ran, {"FRAMES": 30, "SIZE": 64, "STEPS": 40, "GAUSSIANS": 1500})
    cells = {cell["id"]: cell for cell in code_cells(ran)}
    kinds = {
        name: [sorted(out.get("data", {"text": 0})) for out in cell["outputs"]]
        for name, cell in cells.items()
    }
    before = {
        cell["id"]: [sorted(out.get("data", {"text": 0})) for out in cell["outputs"]]
        for cell in code_cells(stored)
    }
    assert kinds == before
    assert "text/html" in cells["turn"]["outputs"][0]["data"]
    picture = cells["angles"]["outputs"][0]["data"]["image/png"]
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(picture))))
    assert (pixels < 200).any(axis=-1).mean() > 0.05
    assert "Use -47 to 82" in cells["refused"]["outputs"][0]["text"]
    (score,) = re.findall(r"PSNR ([\d.]+) dB", cells["frame"]["outputs"][0]["text"])
    assert float(score) > 10.0


@pytest.mark.slow
@pytest.mark.usefixtures("machine_code")
def test_the_notebook_of_a_method_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    stored = json.loads((ROOT / "docs" / "notebooks" / "method.ipynb").read_text("utf-8"))
    ran, before = copy.deepcopy(stored), sys.modules["__main__"]
    run_notebook(ran, {"FRAMES": 20, "SIZE": 64, "STEPS": 20})
    assert sys.modules["__main__"] is before
    cells = {cell["id"]: cell["outputs"] for cell in code_cells(ran)}
    for cell in code_cells(stored):
        found = [out["output_type"] for out in cells[cell["id"]]]
        assert found == [out["output_type"] for out in cell["outputs"]]
    # The class of the notebook has run in the sandbox, and drew a hand rather than grey.
    results = [hwp_bench.read_results(f"demo/{name}") for name in ("mine", "plain")]
    assert [one.captures[0].failure for one in results] == [None, None]
    assert results[0].scores["psnr"] > 15.0
    table = "".join(cells["frame"][0]["data"]["text/html"])
    assert all(one.method.title in table for one in results)
    assert "image (8, 64, 64, 3)" in cells["batch"][0]["text"]
    assert re.match(r"step 1: [\d.]+ dB, step \d+: ", cells["curves"][0]["text"])
