"""Code and pages are in plain English. Oracle: a list of turns that readers stumble over.

Each entry names the usual way to say it; `CONTRIBUTING.md` has the glossary.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FILES = [
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "studies").glob("*.md")),
    *sorted((ROOT / "baselines").glob("*/README.md")),
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *(
        path
        for folder in ("hwp_bench", "wildghand", "baselines", "tools")
        for path in sorted((ROOT / folder).rglob("*"))
        if path.suffix in {".py", ".pyi", ".toml", ".j2"}
    ),
]

#: A pattern, and what to write in its place.
TURNS = {
    r"(?<![Tt]here )\b(?:is|are|was|were) no\b(?! longer| more than)": "is not a, has no, cannot",
    r"\bwhole numbers?\b": "integer",
    r"\banew\b": "again",
    r"\b(?:thrice|heretofore|whence|wherefore)\b": "a modern word",
    r"\bnot to be had\b": "is not available",
    r"\bbeside\b": "next to, besides, and",
    r"\bstrangers?\b": "untrusted, a user",
    r"\bspellings?\b": "format",
    r"\bhangs? on\b": "depends on",
    r"\bmended\b": "corrected, repaired",
    r"\boptimis": "optimiz",
    r'"""What (?:is|was|are|were|the|an?|it|they|every|one|each)\b': "say the thing itself",
}


def test_there_is_something_to_read() -> None:
    assert len(FILES) > 300


@pytest.mark.parametrize("turn", TURNS)
def test_plain_english(turn: str) -> None:
    pattern = re.compile(turn)
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()[:90]}"
        for path in FILES
        for number, line in enumerate(path.read_text("utf-8").splitlines(), start=1)
        if pattern.search(line)
    ]
    assert found == [], f"better: {TURNS[turn]}"
