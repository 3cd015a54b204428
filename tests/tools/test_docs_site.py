"""Terms are linked to the glossary. Oracle: a page by hand."""

from __future__ import annotations

from tools.docs_site import glossary_terms, link_terms

GLOSSARY = "| word | meaning |\n| --- | --- |\n| clip | frames |\n| free-view clip | views |\n"


def test_the_first_use_of_a_term_is_linked_outside_of_code_and_links() -> None:
    terms = glossary_terms(GLOSSARY)
    assert terms == ["free-view clip", "clip"]
    head = "# A clip\n`clip` and [a clip](x.md).\n```\nclip\n```\n"
    page = f"{head}The free-view clip, two Clips, a clip."
    linked = "The [free-view clip](glossary.md), two [Clips](glossary.md), a clip."
    assert link_terms(page, terms) == head + linked
