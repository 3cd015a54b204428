"""Code on pages of users runs as it stands. Oracle: the shapes that the pages state."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tiny_fits import UNJUDGED

from hwp_bench.capture import Capture

DOCS = Path(__file__).resolve().parents[1] / "docs"
#: Pages whose code is tested elsewhere: by `test_docs.py`, `test_python_page.py`,
#: `test_tutorial.py`, or a part of a longer function.
ELSEWHERE = {"architecture", "methods", "python", "tutorial-method", "export"}


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text("utf-8"), re.DOTALL | re.MULTILINE)


PAGES = sorted(p.stem for p in DOCS.glob("*.md") if blocks(p) and p.stem not in ELSEWHERE)


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory, make_painted: Callable[[str], Capture]) -> Path:
    """A folder with `my_capture`, and with `my_avatar` that was fitted to it."""
    import wildghand

    folder = tmp_path_factory.mktemp("pages")
    shutil.copytree(make_painted("right").root, folder / "my_capture")
    wildghand.fit(folder / "my_capture", folder / "my_avatar", steps=2, settings=UNJUDGED)
    return folder


def test_the_pages_are_known() -> None:
    assert {"live", "network", "prepass", "splatting", "video", "viewer"} == set(PAGES)


@pytest.mark.slow
@pytest.mark.usefixtures("machine_code")
@pytest.mark.parametrize("page", PAGES)
def test_the_code_of_a_page_runs(page: str, work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(work)
    names: dict[str, Any] = {}
    for code in blocks(DOCS / f"{page}.md"):
        exec(compile(code, page, "exec"), names)
    if page == "live":
        assert names["image"].shape == (512, 512, 4)
    if page == "network":
        assert names["drawn"].colors.shape == (1, 12_337, 3)
    if page == "prepass":
        assert len(names["assessment"].clean) == len(names["capture"])
    if page == "splatting":
        assert names["colors"].shape == (1, 256, 256, 3)
    if page == "video":
        assert (work / "496.json").is_file()
    if page == "viewer":
        assert (work / "avatar.html").stat().st_size > 100_000
