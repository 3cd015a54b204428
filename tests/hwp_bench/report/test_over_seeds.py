"""Rows of several seeds. Oracle: means that are taken by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest
from made_results import made_results

from hwp_bench.base.tables import Column, Table
from hwp_bench.report.evaluation_tables import all_tables, labels
from hwp_bench.report.over_seeds import over_seeds


def results():
    """Two methods; one has three seeds, a decibel apart."""
    mine = [made_results("mine", lambda c, f, s, n=n: 20.0 + n, seed=n) for n in (0, 1, 2)]
    return [mine[0], made_results("plain", lambda c, f, s: 15.0), *mine[1:]]


@pytest.mark.parametrize("name", ["overall", "captures", "perturbations", "details", "micro"])
def test_tables_of_evaluations_show_means_over_seeds(name: str) -> None:
    found = results()
    table = all_tables(found)[name]
    merged = over_seeds(table, found)
    place = [column.title for column in merged.columns].index("Method")
    first = next(
        index for index, column in enumerate(merged.columns) if column.title.startswith("PSNR")
    )
    assert {str(row[place]) for row in merged.rows} == {"Mine", "Plain"}
    assert len(merged.rows) * 2 == len(table.rows)
    for row in merged.rows:
        assert row[first] == pytest.approx(21.0 if row[place] == "Mine" else 15.0)
    assert len(merged.breaks) == len(table.breaks)
    assert "Means over seeds" in merged.notes[-1]


def test_counts_are_added_texts_joined_and_gaps_stay() -> None:
    found = results()
    names = labels(found)
    columns = tuple(
        Column(title) for title in ("Block", "Method", "PSNR", "Failed", "Made by", "LPIPS")
    )
    rows = tuple(
        (block, name, 20.0 + number, number, f"maker {number % 2}", None if number else 0.1)
        for block in ("a", "b")
        for number, name in enumerate(names)
    )
    table = Table("T", columns, rows, breaks=(4,), unranked=frozenset({1, 4}))
    merged = over_seeds(table, found)
    assert merged.rows == (
        ("a", "Mine", pytest.approx(65 / 3), 5, "maker 0, maker 1", None),
        ("a", "Plain", 21.0, 1, "maker 1", None),
        ("b", "Mine", pytest.approx(65 / 3), 5, "maker 0, maker 1", None),
        ("b", "Plain", 21.0, 1, "maker 1", None),
    )
    assert merged.breaks == (2,)
    # A row is left out of the ranks only if all its seeds are.
    assert merged.unranked == {1}


def test_a_table_without_several_seeds_stays_as_it_is() -> None:
    single = results()[:2]
    table = all_tables(single)["overall"]
    assert over_seeds(table, single) is table
    # One evaluation that is given twice is no second seed.
    twice = [single[0], replace(single[0])]
    table = all_tables(twice)["overall"]
    assert over_seeds(table, twice) is table
