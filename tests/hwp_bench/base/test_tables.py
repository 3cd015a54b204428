"""Spellings of a table. Oracles: csv and json readers; what LaTeX and Markdown require."""

from __future__ import annotations

import csv
import io
import json
import re
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.base.tables import (
    Column,
    Table,
    draw_table,
    format_table,
    print_table,
    without_empty_columns,
)

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


def lines_of(table: Table, width: int, *, styled: bool = True) -> list[str]:
    """The lines of a table without the codes of a terminal."""
    drawn = draw_table(table, width, styled=styled)
    return re.sub(r"\x1b\[[0-9;]*m", "", drawn).splitlines()


WORDS = st.text("abcdefgh", min_size=1, max_size=9)
TITLES = st.lists(WORDS, min_size=1, max_size=4).map(" ".join)
NUMBERS = st.floats(-999, 99999, allow_nan=False) | st.none()


@st.composite
def tables(draw) -> Table:
    """Tables of one or two texts and up to fourteen numbers a row, in groups."""
    texts = draw(st.integers(1, 2))
    columns = [Column(draw(TITLES)) for _ in range(texts)]
    for _ in range(draw(st.integers(0, 5))):
        group = draw(TITLES | st.just(""))
        for _ in range(draw(st.integers(1, 3))):
            better = draw(st.sampled_from([True, False, None]))
            columns.append(Column(draw(TITLES), draw(st.integers(0, 4)), better, group))
    rows = tuple(
        (*(draw(TITLES) for _ in range(texts)), *(draw(NUMBERS) for _ in columns[texts:]))
        for _ in range(draw(st.integers(1, 4)))
    )
    return Table(draw(TITLES), tuple(columns), rows, (draw(TITLES),))


@settings(max_examples=150, deadline=None)
@given(tables(), st.integers(60, 200), st.booleans())
def test_no_number_is_cut_and_no_line_is_too_long(table: Table, width: int, styled: bool) -> None:
    lines = lines_of(table, width, styled=styled)
    assert max(map(len, lines)) <= width
    words = [word.rstrip("*") for line in lines for word in line.split()]
    for row in range(len(table.rows)):
        for column in range(len(table.columns)):
            for word in table.text(row, column).split():
                assert words.count(word) >= 1
                words.remove(word)
    for column in table.columns:
        assert all(word in words for word in column.heading.split())


WIDE_TABLE = Table(
    "All captures",
    (
        Column("Method"),
        *(
            Column(title, digits, better, group)
            for group in ("Single", "Interacting", "Macro")
            for title, digits, better in (
                ("PSNR [dB]", 2, True),
                ("SSIM", 4, True),
                ("Oriented distance", 4, False),
            )
        ),
    ),
    (
        ("Plain fit", 27.35, 0.8168, 0.0193, 27.17, 0.8338, 0.0142, 27.29, 0.8274, 0.0164),
        ("Prediction network", 23.67, 0.76, 0.03, 25.52, 0.79, 0.02, 24.69, 0.77, 0.03),
    ),
)


def test_columns_that_do_not_fit_follow_in_a_block_of_their_own() -> None:
    lines = lines_of(WIDE_TABLE, 80)
    assert lines[0] == "All captures"
    assert lines[1].replace("─", "").split() == ["Single", "Interacting"]
    first, second = (index for index, line in enumerate(lines) if line.startswith("Plain fit"))
    assert lines[first].split() == [
        "Plain",
        "fit",
        "27.35",
        "0.8168",
        "0.0193",
        "27.17",
        "0.8338",
        "0.0142",
    ]
    assert lines[second].split() == ["Plain", "fit", "27.29", "0.8274", "0.0164"]
    # Numbers of a column stand under each other: its digits end where its heading ends.
    assert len(lines[first]) == len(lines[first + 1])
    # A wide terminal shows everything side by side.
    wide = lines_of(WIDE_TABLE, 120)
    assert sum(line.startswith("Plain fit") for line in wide) == 1


def test_best_values_are_marked_where_nothing_can_be_bold(capsys, monkeypatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    print_table(WIDE_TABLE)
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80
    assert "27.35*" in out
    assert "23.67 " in out
    assert "* the best of the rows on the same data." in out
    styled = draw_table(WIDE_TABLE, 80, styled=True)
    assert "\x1b[1m27.35\x1b" in styled
    assert "\x1b[4m23.67\x1b" in styled
    print_table(replace(WIDE_TABLE, ranked=False))
    assert "*" not in capsys.readouterr().out


def test_long_texts_are_folded_and_lines_separate_blocks() -> None:
    table = Table(
        "T",
        (Column("Method"), Column("Score", 1, True), Column("Meaning")),
        (("a" * 40, 1.0, "word " * 30), ("b", 2.0, "x")),
        breaks=(1,),
    )
    lines = lines_of(table, 80)
    assert max(map(len, lines)) <= 80
    assert sum(line.count("word") for line in lines) == 30
    assert "".join(lines).count("a" * 12) >= 3
    assert sum(set(line) == {"─"} for line in lines) == 2


@settings(max_examples=100, deadline=None)
@given(st.lists(NUMBERS, min_size=2, max_size=12), st.integers(1, 4), st.integers(40, 90))
def test_a_block_says_once_what_its_rows_share(
    numbers: list[float | None], size: int, width: int
) -> None:
    rows = tuple(
        (f"block{place // size}", f"row{place}", number) for place, number in enumerate(numbers)
    )
    columns = (Column("Block"), Column("Row"), Column("Value", 2, True))
    table = Table("T", columns, rows, breaks=tuple(range(size, len(rows), size)))
    words = " ".join(lines_of(table, width)).split()
    repeats = range(0, len(rows), size) if table.breaks else range(len(rows))
    assert [word for word in words if word.startswith("block")] == [rows[i][0] for i in repeats]
    assert [word for word in words if word.startswith("row")] == [row[1] for row in rows]
    assert all(table.text(row, 2) in words for row in range(len(rows)))


def test_a_repeated_text_stands_once_in_its_block() -> None:
    columns = (Column("What is new"), Column("Class"), Column("Method"), Column("PSNR", 2, True))
    rows = tuple(
        ("Angle to the nearest", kind, method, 20.0)
        for kind in ("near", "far")
        for method in ("A", "B")
    )
    printed = lines_of(Table("T", columns, rows, breaks=(2,)), 30)
    assert printed[2:] == [
        "What is new   Class  Method      ↑",
        "──────────────────────────────────",
        "Angle to the  near   A       20.00",
        "nearest",
        "                     B       20.00",
        "──────────────────────────────────",
        "Angle to the  far    A       20.00",
        "nearest",
        "                     B       20.00",
    ]
