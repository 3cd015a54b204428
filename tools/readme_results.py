"""Write the results of the README from the entries of the leaderboard.

`python -m tools.readme_results` writes the block between the two comments in README.md;
`tests/test_readme_results.py` fails where the block is not what the entries say.
"""

from __future__ import annotations

from pathlib import Path

from hwp_bench.analysis.columns import Filled, table_of
from hwp_bench.base.files import atomic_write
from hwp_bench.base.tables import Column, format_table
from hwp_bench.leaderboard.board import BoardRow, method_rows, ranks_of
from hwp_bench.leaderboard.entries import read_entries
from hwp_bench.leaderboard.rules import left_out

ROOT = Path(__file__).resolve().parents[1]
README, ENTRIES = ROOT / "README.md", ROOT / "leaderboard" / "entries"
BEGIN, END = "<!-- results: python -m tools.readme_results -->\n", "<!-- end of results -->\n"
# Suites in the order in which they say most.
_SUITES = ("wild-test", "real-1", "mini", "full-lite", "full")
_SCORE = "psnr"


def results_block() -> str:
    """A table with a line a suite, and a sentence a suite that says who leads and how surely."""
    entries = read_entries(ENTRIES, left_out)
    suites = [name for name in _SUITES if any(one.results.suite == name for one in entries)]
    lines: list[dict[str, str]] = []
    sentences: list[str] = []
    for name in suites:
        own = method_rows([one for one in entries if one.results.suite == name])
        _, sentence = ranks_of(own)
        lines.append(_line(name, own))
        sentences.append(f"- **{name}**: {sentence}")
    columns: list[Filled] = [(Column(title), [line[title] for line in lines]) for title in lines[0]]
    table = format_table(table_of("PSNR of clean test frames, dB", columns), "md")
    return f"{BEGIN}{table.strip()}\n\n" + "\n".join(sentences) + f"\n{END}"


def _line(suite: str, rows: list[BoardRow]) -> dict[str, str]:
    by_name = {row.first.method.name: row for row in rows}
    ours, plain = by_name.get("wildghand"), by_name.get("plain")
    others = [row for name, row in by_name.items() if name != "wildghand"]
    best = max(others, key=lambda row: row.scores[_SCORE], default=None)
    captures = len(rows[0].first.captures)
    return {
        "Suite": f"{suite}, {captures} captures",
        "Fit": rows[0].budget.split(", ")[0],
        "Seeds": str(len(rows[0].seeds)),
        "WildGHand": _score(ours),
        "Best other": "–" if best is None else f"{best.title}, {_score(best)}",
        "Plain fit": _score(plain),
    }


def _score(row: BoardRow | None) -> str:
    return "–" if row is None else f"{row.scores[_SCORE]:.2f}"


def with_block(text: str, block: str) -> str:
    """The README with another block of results."""
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    return before + block + after


if __name__ == "__main__":
    atomic_write(README, with_block(README.read_text("utf-8"), results_block()), overwrite=True)
