"""Spellings of a table. Oracles: csv and json readers; what LaTeX and Markdown require."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace

import pytest

from hwp_bench.base.tables import Column, Table, format_table, print_table, without_empty_columns

TABLE = Table(
    "Scores & more",
    (
        Column("Method"),
        Column("PSNR", 2, True, "Single"),
        Column("Distance", 3, False, "Single"),
        Column("Frames"),
    ),
    (
        ("plain_fit", 20.123456, 0.5, 3),
        ("best|one", 22.0, 0.25, 3),
        ("third", 22.001, None, 3),
    ),
    ("A note: 100 %.",),
)


def test_ranks_follow_direction_and_printed_digits() -> None:
    # 22.000 and 22.001 print alike, so both are best.
    assert [TABLE.rank(row, 1) for row in range(3)] == [1, 0, 0]
    assert [TABLE.rank(row, 2) for row in range(3)] == [1, 0, None]
    assert [TABLE.rank(row, 3) for row in range(3)] == [None] * 3


def test_markdown_marks_best_and_second_and_escapes() -> None:
    text = format_table(TABLE, "md")
    assert r"| best\|one | **22.00** | **0.250** | 3 |" in text
    assert r"| plain\_fit | <u>20.12</u> | <u>0.500</u> | 3 |" in text
    assert "Single PSNR ↑" in text
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert {line.replace(r"\|", "").count("|") for line in lines} == {5}


def test_a_group_named_as_its_column_is_said_once() -> None:
    table = Table("t", (Column("Rank", 0, group="Rank"), Column("95 %", group="Rank")), ((1, "1"),))
    assert format_table(table, "csv").splitlines()[0] == "Rank,Rank 95 %"
    assert "| Rank | Rank 95 % |" in format_table(table, "md")
    assert '"Rank": 1' in format_table(table, "json")


def test_latex_is_booktabs_with_groups_and_escapes() -> None:
    text = format_table(TABLE, "tex")
    assert r"\textbf{22.00}" in text
    assert r"\underline{20.12}" in text
    assert r"\multicolumn{2}{c}{Single}" in text
    assert r"\cmidrule(lr){2-3}" in text
    assert r"plain\_fit" in text
    assert r"Scores \& more" in text
    assert r"PSNR $\uparrow$" in text
    assert r"100 \%." in text
    for begin, end in ((r"\begin{table}", r"\end{table}"), (r"\toprule", r"\bottomrule")):
        assert text.count(begin) == text.count(end) == 1


def test_csv_and_json_keep_full_precision() -> None:
    rows = list(csv.reader(io.StringIO(format_table(TABLE, "csv"))))
    assert rows[0] == ["Method", "Single PSNR", "Single Distance", "Frames"]
    assert float(rows[1][1]) == 20.123456
    assert rows[3][2] == ""
    value = json.loads(format_table(TABLE, "json"))
    assert value["rows"][0]["Single PSNR"] == 20.123456
    assert value["rows"][2]["Single Distance"] is None
    assert value["columns"][2]["higher_is_better"] is False


def test_terminal_output_is_plain_and_complete_in_a_pipe(capsys) -> None:
    print_table(TABLE)
    text = capsys.readouterr().out
    assert "\x1b" not in text
    for word in ("plain_fit", "best|one", "22.00", "0.250", "A note: 100 %."):
        assert word in text


def test_rows_are_ranked_within_their_block_and_published_ones_never() -> None:
    table = replace(TABLE, rows=(*TABLE.rows, ("fourth", 30.0, 0.1, 3)), breaks=(2,))
    assert [table.rank(row, 1) for row in range(4)] == [1, 0, 1, 0]
    kept = replace(table, unranked=frozenset({3}))
    assert [kept.rank(row, 1) for row in range(4)] == [1, 0, None, None]
    # A line between the blocks, and the one under the heading.
    assert format_table(table, "tex").count(r"\midrule") == 2


def test_columns_without_any_value_are_dropped() -> None:
    rows = tuple((name, psnr, None, frames) for name, psnr, _, frames in TABLE.rows)
    kept = without_empty_columns(replace(TABLE, rows=rows))
    assert [column.title for column in kept.columns] == ["Method", "PSNR", "Frames"]
    assert kept.rows[0] == ("plain_fit", 20.123456, 3)


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", " =cmd|' /C calc'!A0"])
def test_no_text_of_a_csv_is_a_formula(text: str) -> None:
    """Oracle: OWASP's list of first characters; numbers stay numbers."""
    table = Table("c", (Column(text), Column("Score")), ((text, -1.5),))
    rows = list(csv.reader(io.StringIO(format_table(table, "csv"))))
    assert rows[0][0] == "'" + text.strip()
    assert rows[1] == ["'" + text, "-1.5"]
