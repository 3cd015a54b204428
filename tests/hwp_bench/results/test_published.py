"""The paper's numbers. Oracle: the paper's source, read again where it is at hand."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from hwp_bench.results.published import read_published
from hwp_bench.taxonomy import PERTURBATIONS

SOURCE = Path(__file__).resolve().parents[4] / "shared" / "paper" / "wildghand.tex"


def paper_tables() -> dict[str, list[list[str]]]:
    """Cells of every table's body by label, LaTeX markup taken away."""
    found = {}
    text = SOURCE.read_text(encoding="utf-8")
    for body in re.findall(r"\\begin\{table\*?\}(.*?)\\end\{table\*?\}", text, re.DOTALL):
        label = re.search(r"\\label\{(.*?)\}", body).group(1)
        rows = re.search(r"\\midrule(.*)\\bottomrule", body, re.DOTALL).group(1)
        rows = re.sub(r"\\cite\{.*?\}|~|\\hline", "", rows)
        rows = re.sub(r"\\textbf\{(.*?)\}", r"\1", rows)
        found[label] = [
            [cell.strip() for cell in row.split("&")] for row in rows.split(r"\\") if "&" in row
        ]
    return found


def numbers(cells: list[str]) -> list[float]:
    pieces = [piece for cell in cells for piece in cell.split(r"$\pm$")]
    return [float(piece) for piece in pieces if re.fullmatch(r"\d+\.\d+", piece)]


@pytest.mark.skipif(not SOURCE.is_file(), reason="the paper's source is not here")
def test_every_number_is_the_papers() -> None:
    sources = paper_tables()
    # Rows whose "&" belongs to a name hold their numbers in the other cells all the same.
    published = read_published()
    assert [table.number for table in published.tables] == list(range(3, 11))
    for table in published.tables:
        printed = [number for row in sources[table.label] for number in numbers(row)]
        typed = []
        for item in table.measurements:
            for name, value in item.scores.items():
                typed.append(value)
                typed += [item.deviations[name]] if name in item.deviations else []
        assert typed == printed, table.label
    labels = list(sources)
    # The numbers of the tables follow their order in the paper.
    assert [labels.index(table.label) + 1 for table in published.tables] == list(range(3, 11))


@pytest.mark.skipif(not SOURCE.is_file(), reason="the paper's source is not here")
def test_every_method_stands_at_its_numbers() -> None:
    sources = paper_tables()
    for table in read_published().tables:
        if table.number in (3, 4, 5, 10):
            for item in table.measurements:
                row = next(r for r in sources[table.label] if r[0].startswith(item.method))
                assert set(item.scores.values()) <= set(numbers(row)), (table.label, item)


@pytest.mark.skipif(not SOURCE.is_file(), reason="the paper's source is not here")
def test_data_sets_are_as_in_the_papers_first_table() -> None:
    rows = paper_tables()["tab:dataset_comparison"]
    names = ("clean_test", "single", "interacting", *PERTURBATIONS)
    typed = [
        [item.name, item.environment, *(name in item.has for name in names)]
        for item in read_published().datasets
    ]
    printed = [
        [row[0].removesuffix(" (Ours)"), row[1], *("checkmark" in cell for cell in row[2:])]
        for row in rows
    ]
    assert typed == printed
