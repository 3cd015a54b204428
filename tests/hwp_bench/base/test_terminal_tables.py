"""Tables on a terminal. Oracle: the numbers of the table, found again in what is printed."""

from __future__ import annotations

import re
from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.base.tables import Column, Table, draw_table, print_table


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


TABLE = Table(
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
    lines = lines_of(TABLE, 80)
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
    wide = lines_of(TABLE, 120)
    assert sum(line.startswith("Plain fit") for line in wide) == 1


def test_best_values_are_marked_where_nothing_can_be_bold(capsys, monkeypatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    print_table(TABLE)
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80
    assert "27.35*" in out
    assert "23.67 " in out
    assert "* the best of the rows on the same data." in out
    styled = draw_table(TABLE, 80, styled=True)
    assert "\x1b[1m27.35\x1b" in styled
    assert "\x1b[4m23.67\x1b" in styled
    print_table(replace(TABLE, ranked=False))
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


def test_a_repeated_text_flows_down_over_the_rows_that_repeat_it() -> None:
    columns = (Column("What is new"), Column("Class"), Column("Method"), Column("PSNR", 2, True))
    what = "Angle to the nearest training normal of all"
    rows = tuple(
        (what, kind, method, 20.0 + place)
        for place, (kind, method) in enumerate(
            (kind, method) for kind in ("near", "far") for method in ("A", "B", "C")
        )
    )
    printed = lines_of(Table("T", columns, rows, breaks=(3,)), 30)
    assert printed[2:] == [
        "What is new   Class  Method      ↑",
        "──────────────────────────────────",
        "Angle to the  near   A       20.00",
        "nearest              B       21.00",
        "training             C       22.00",
        "normal of",
        "all",
        "──────────────────────────────────",
        "Angle to the  far    A       23.00",
        "nearest              B       24.00",
        "training             C       25.00",
        "normal of",
        "all",
    ]
