"""Pages are short and plain. Oracle: words counted here, and phrases that readers stumble over.

The phrases are looked for in docstrings, comments, help and messages too. `GENERATED` pages are
written by programs; `CONTRIBUTORS` has pages that users do not read. Decibels:
`hwp-bench dev docs-results --check`.
"""

from __future__ import annotations

import ast
import re
import statistics
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
GENERATED = {"ablation", "clean_share", "field"}
CONTRIBUTORS = {"architecture", "decisions", "performance"}
PAGES = sorted({path.stem for path in DOCS.glob("*.md")} - GENERATED)
#: Most words of a page, of the pages of users together, and of all studies; no blocks of code.
LONGEST_PAGE, ALL_PAGES, ALL_STUDIES = 2_000, 25_000, 15_000
LONGEST_SENTENCE, MEAN_SENTENCE = 45, 30
STUDIES = sorted((DOCS / "studies").glob("*.md"))

#: Phrases to avoid, and what is usual in their place.
PHRASES = {
    r"\b[Ww]hat (?:\w+ ){1,4}errs? by\b": "the error of ...",
    r"(?<!there )\bis none\b": "is not a, has no",
    r"\bas far as\b(?! possible)(?! another)": "to, until, where",
    r"\b[Gg]o(?:es|ing|ne)? on\b": "continues",
    r"\b[Ii]n the mean of\b": "on average over",
    r"\bso that [^.;:]* no more\b": "two sentences",
    r"\bnobody's\b": "unconstrained, unknown",
    r"\b(?:is|are|was|were) told from\b": "distinguished from",
    r"\bnothing else [^.]* than\b": "only",
    r"\bbe had\b": "available",
}
#: As git prints a commit: hexadecimal, with a digit and a letter.
HASH = re.compile(r"\b(?=[a-f]*\d)(?=\d*[a-f])[0-9a-f]{7,40}\b")


def prose(text: str) -> str:
    """Return a page without blocks of code, pictures and addresses; a span of code is one word."""
    text = re.sub(r"^( *)```.*?^ *```", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"`[^`\n]+`", "CODE", text)
    return re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)


def words(text: str) -> int:
    """Return the number of words; bars of tables are none."""
    return sum(bool(re.search(r"\w", word)) for word in text.split())


def sentences(text: str) -> list[str]:
    """Return the sentences of paragraphs, items of lists and cells of tables."""
    units: list[str] = []
    ended = True
    for line in prose(text).splitlines():
        # Headings, rows and blank lines stand alone; other lines continue a paragraph or an item.
        alone = not line.strip() or line.startswith(("#", "|"))
        if alone or ended or re.match(r"\s*(?:[-*]|\d+\.) ", line):
            units += line.split("|")
        else:
            units[-1] += " " + line
        ended = alone
    ends = re.compile(r"(?<=[.!?])\W*\s+(?=\W*[A-Z])")
    return [part for unit in units for part in ends.split(unit) if words(part) > 2]


def read(page: str) -> str:
    return (DOCS / f"{page}.md").read_text("utf-8")


def test_sentences_are_counted_by_hand() -> None:
    text = (
        "# A title here\nOne two three. Four `a b c` six\nseven eight.\n\n"
        "| a [b c](d.md) e | f. Good day to you |\n\n```\nnot this at all\n```\n"
        "- an item of five words\n"
    )
    counts = [words(sentence) for sentence in sentences(text)]
    assert counts == [3, 3, 5, 4, 4, 5]
    assert HASH.search("commit 94f10c3 of it")
    assert not HASH.search("1234567 frames were defaced")


@pytest.mark.parametrize("page", PAGES)
def test_sentences_are_short(page: str) -> None:
    counts = {sentence.strip(): words(sentence) for sentence in sentences(read(page))}
    assert len(counts) > 10
    assert {s: n for s, n in counts.items() if n > LONGEST_SENTENCE} == {}
    assert statistics.mean(counts.values()) <= MEAN_SENTENCE


@pytest.mark.parametrize("page", PAGES)
def test_pages_keep_their_length_and_have_no_commits(page: str) -> None:
    text = prose(read(page))
    assert words(text) <= LONGEST_PAGE, "shorten it, or move measurements to docs/studies"
    assert HASH.findall(text) == []
    assert re.findall(r"commit CODE", text) == []


def test_all_pages_together_are_a_day_s_reading() -> None:
    counts = {page: words(prose(read(page))) for page in PAGES if page not in CONTRIBUTORS}
    assert sum(counts.values()) <= ALL_PAGES, counts
    assert sum(words(prose(path.read_text("utf-8"))) for path in STUDIES) <= ALL_STUDIES


@pytest.mark.parametrize("phrase", PHRASES)
def test_phrases_are_plain(phrase: str) -> None:
    pages = {page: prose(read(page)) for page in PAGES}
    found = [f"{page}: {m[0]}" for page in pages for m in re.finditer(phrase, pages[page])]
    assert found == [], f"better: {PHRASES[phrase]}"


@pytest.fixture(scope="module")
def code_texts() -> list[tuple[str, str]]:
    """The place and text of each docstring, comment, help and message; words of code are out."""
    texts = []
    for folder in ("hwp_bench", "wildghand", "baselines", "tools", "benchmarks"):
        for path in sorted((DOCS.parent / folder).rglob("*.py")):
            source = path.read_text("utf-8")
            place = path.relative_to(DOCS.parent).as_posix()
            for node in ast.walk(ast.parse(source)):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    texts.append((f"{place}:{node.lineno}", " ".join(node.value.split())))
            comments = enumerate(re.findall(r"^.*$", source, re.MULTILINE), start=1)
            texts += [
                (f"{place}:{n}", line.split("#", 1)[1]) for n, line in comments if "# " in line
            ]
    return [(place, re.sub(r"`[^`]+`", "CODE", text)) for place, text in texts if " " in text]


@pytest.mark.parametrize("phrase", PHRASES)
def test_phrases_of_docstrings_and_messages_are_plain(
    code_texts: list[tuple[str, str]], phrase: str
) -> None:
    assert len(code_texts) > 5_000
    found = [f"{place}: {m[0]}" for place, text in code_texts for m in re.finditer(phrase, text)]
    assert found == [], f"better: {PHRASES[phrase]}"


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_a_study_has_a_question_an_answer_and_a_date(path: Path) -> None:
    text = path.read_text("utf-8")
    assert re.match(r"# .*\?\n", text), "the title is the question"
    assert re.search(r"^- \*\*Answer\*\*: \S", text, re.MULTILINE)
    assert re.search(r"^- \*\*Date, status\*\*: .*20\d\d", text, re.MULTILINE)
    # Blocks of results say by which commit they were made.
    by_hand = re.sub(r"<!-- results: .*?<!-- end -->", "", text, flags=re.DOTALL)
    assert HASH.findall(prose(by_hand)) == []
