"""Pages of the site. Oracle: a page by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.docs_site import build, glossary_terms, link_terms

GLOSSARY = "| word | meaning |\n| --- | --- |\n| clip | frames |\n| free-view clip | views |\n"


def test_the_first_use_of_a_term_is_linked_outside_of_code_and_links() -> None:
    terms = glossary_terms(GLOSSARY)
    assert terms == ["free-view clip", "clip"]
    head = "# A clip\n`clip` and [a clip](x.md).\n```\nclip\n```\n"
    page = f"{head}The free-view clip, two Clips, a clip."
    linked = "The [free-view clip](glossary.md), two [Clips](glossary.md), a clip."
    assert link_terms(page, terms) == head + linked


def test_a_folder_of_other_pages_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "docs" / "mine.md"
    page.parent.mkdir()
    page.write_text("mine")
    monkeypatch.setattr("tools.docs_site.write_pages", lambda docs: None)
    monkeypatch.setattr("tools.docs_site.subprocess.run", lambda *given, **more: None)
    with pytest.raises(SystemExit, match="something else"):
        build(tmp_path)
    assert page.read_text() == "mine"
