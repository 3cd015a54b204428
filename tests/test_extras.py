"""The table of extras. Oracle: the extras of pyproject.toml."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
EXTRAS: dict[str, list[str]] = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))[
    "project"
]["optional-dependencies"]


def rows() -> dict[str, str]:
    """What a person gets, by the name of the extra."""
    section = (
        (ROOT / "docs" / "install.md").read_text("utf-8").split("## Extras\n")[1].split("\n## ")[0]
    )
    found = re.findall(r"^\| `([\w-]+)` \| (.+) \|$", section, re.MULTILINE)
    assert len(found) == len(dict(found))
    return dict(found)


def package(requirement: str) -> str:
    return re.split(r"[\[<>=!~; ]", requirement)[0].lower().replace("_", "-")


def test_the_page_has_a_row_for_every_extra_and_no_other() -> None:
    assert set(rows()) == set(EXTRAS)
    assert all(len(words) > 20 for words in rows().values())


def test_the_row_of_the_test_extra_names_the_extras_that_it_contains() -> None:
    inside = {package(requirement) for requirement in EXTRAS["test"]}
    contained = {
        name
        for name, requirements in EXTRAS.items()
        if name != "test"
        and requirements
        and ({package(r) for r in requirements} <= inside or f"hwp-bench[{name}]" in EXTRAS["test"])
    }
    assert set(re.findall(r"`(\w+)`", rows()["test"])) == contained


def test_what_tests_run_with_is_pinned() -> None:
    lines = (ROOT / "constraints.txt").read_text("utf-8").splitlines()
    pinned = {package(line) for line in lines if "==" in line}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    wanted = {package(r) for r in (*project["dependencies"], *EXTRAS["test"], *EXTRAS["docs"])}
    assert wanted - {"hwp-bench"} - pinned == set()
