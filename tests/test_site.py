"""The site of the documentation builds without a warning and stands alone. Oracle: its pages."""

from __future__ import annotations

import importlib
import os
import re
from pathlib import Path

import pytest
import yaml

from tools.docs_site import API, build

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site; in strict mode a link or an anchor that leads nowhere ends the build."""
    return build(tmp_path_factory.mktemp("site"))


def test_every_page_of_docs_is_there(site: Path) -> None:
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")}
    assert len(pages) > 15
    assert {page for page in pages if not (site / f"{page}.html").is_file()} == set()
    assert "Cite it" in (site / "index.html").read_text(encoding="utf-8")
    assert "oracle of a test" in (site / "contributing.html").read_text(encoding="utf-8")
    assert 'href="glossary.html"' in (site / "start.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("package", API)
def test_the_reference_has_every_public_name(site: Path, package: str) -> None:
    page = (site / "api" / f"{package}.html").read_text(encoding="utf-8")
    names = getattr(importlib.import_module(package), "__all__", [])
    headings = re.findall(r'<h\d id="([\w.]+)" class="doc', page)
    listed = {heading.rpartition(".")[2] for heading in headings}
    assert set(names) - listed - {"__version__"} == set()
    assert names or package in ("hwp_bench", "wildghand")


def test_fields_of_records_are_documented(site: Path) -> None:
    page = (site / "api" / "hwp_bench.methods.html").read_text(encoding="utf-8")
    assert "Optimizer steps; None keeps the method" in page


def test_the_fields_of_scene_files_are_listed(site: Path) -> None:
    page = (site / "api" / "scenes.html").read_text(encoding="utf-8")
    cells = [re.sub("<[^>]+>", "", cell) for cell in re.findall(r"<td>(.*?)</td>", page, re.DOTALL)]
    row = cells.index("sharpening")
    assert cells[row + 1 : row + 3] == ["0.0", "0 to 3"]
    assert cells[cells.index("frame_count") + 1] == "required"
    assert all(cells[3::4]), "every field has a meaning"


def test_commands_settings_and_suites_are_listed(site: Path) -> None:
    commands = (site / "api" / "commands.html").read_text(encoding="utf-8")
    for words in ("hwp-bench evaluate", "hwp-bench data import video", "wildghand fit"):
        assert f'id="{words.replace(" ", "-")}"' in commands
        assert commands.count(words) > 3
    settings = (site / "api" / "settings.html").read_text(encoding="utf-8")
    cells = re.findall(r"<td>(.*?)</td>", settings, re.DOTALL)
    cells = [re.sub("<[^>]+>", "", cell) for cell in cells]
    row = cells.index("identity_resolution")
    assert cells[row + 1 : row + 3] == ["160", "4 to 4096"]
    assert all(cells[3::4]), "every setting has a meaning"
    assert "wild-test" in (site / "api" / "suites.html").read_text(encoding="utf-8")


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 25
    for page in pages:
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(
            r"<(?:script|img|iframe|source|video)[^>]*\ssrc=[\"']?([^\"' >]+)", text
        )
        loaded += re.findall(r"<link[^>]*\shref=[\"']?([^\"' >]+)[^>]*>", text)
        elsewhere = [url for url in loaded if re.match(r"(https?:)?//", url)]
        assert elsewhere == [], page.name
    for sheet in site.rglob("*.css"):
        assert not re.search(r"(url\(|@import )[\"']?(https?:)?//", sheet.read_text("utf-8")), sheet


def test_the_workflow_runs_the_ci_script_and_hooks_are_the_project_s_own() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text("utf-8"))
    runs = [
        step["run"] for job in workflow["jobs"].values() for step in job["steps"] if "run" in step
    ]
    assert runs
    assert all(run.startswith(".ci/run") for run in runs)
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text("utf-8"))
    assert {repo["repo"] for repo in hooks["repos"]} == {"local"}


def test_the_site_is_published_and_problems_come_with_facts() -> None:
    github = ROOT / ".github"
    workflow = yaml.safe_load((github / "workflows" / "docs.yml").read_text("utf-8"))
    steps = workflow["jobs"]["publish"]["steps"]
    assert "python -m tools.docs_site build" in [step.get("run") for step in steps]
    assert {"path": "build/site"} in [step.get("with") for step in steps]
    for name in ("problem", "result"):
        form = yaml.safe_load((github / "ISSUE_TEMPLATE" / f"{name}.yml").read_text("utf-8"))
        asked = [part["attributes"].get("label", "") for part in form["body"]]
        assert "Output of `hwp-bench info`" in asked


def test_citation_and_changelog_name_the_version() -> None:
    from hwp_bench import __version__

    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert citation["version"] == __version__
    assert citation["license"] == "Apache-2.0"
    assert {"cff-version", "message", "title", "authors", "references"} <= set(citation)
    # No version has been released.
    assert "## [Unreleased]" in (ROOT / "CHANGELOG.md").read_text("utf-8")
