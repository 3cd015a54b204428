"""The results of the README. Oracle: the entries of the leaderboard."""

from __future__ import annotations

from tools.readme_results import README, results_block, with_block


def test_the_readme_says_what_the_entries_say() -> None:
    text = README.read_text("utf-8")
    assert with_block(text, results_block()) == text, "run python -m tools.readme_results"
