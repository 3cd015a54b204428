"""The table that `hwp-bench table` is asked for."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hwp_bench.analysis.pairing import group_runs
from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.base.files import inside, read_json
from hwp_bench.base.tables import Table
from hwp_bench.report.clean_share import clean_share_table
from hwp_bench.report.paper_layouts import (
    DISTANCE,
    LAYOUTS,
    METRIC_OF,
    Marks,
    bias_layout,
    fact_table,
    layout_table,
    seeds_layout,
)
from hwp_bench.report.pixel_tables import novelty_table, outline_table, sharpness_table
from hwp_bench.report.sources import (
    DataGroup,
    ResultsSource,
    data_groups,
    data_key,
    find_captures,
    open_captures_of,
    read_sources,
    stacked,
)
from hwp_bench.report.study_tables import (
    RANK_NOTE,
    bias_table,
    cost_table,
    discrimination_table,
    rank_table,
    robustness_table,
    seeds_table,
    severity_table,
    winner_note,
)
from hwp_bench.report.tables import all_tables, free_view_table, over_seeds, same_data
from hwp_bench.results import read_results
from hwp_bench.results.schema import add_isolation_note, add_validation_note
from hwp_bench.results.store import ABLATION

#: The paper's table with the same content, by name of our table.
PAPER_OF = {"overall": 3, "paper": 3, "perturbations": 5, "bias": 9, "seeds": 10}
#: Tables under which a sentence says who wins.
VERDICTS = ("overall", "captures", "perturbations", "cost", "seeds")


@dataclass(frozen=True)
class TableRequest:
    """A table to make, and the results to make it of."""

    #: Results folders, `results.json` files or ablation folders.
    paths: Sequence[str | os.PathLike[str]]
    #: Name of the table.
    by: str = "overall"
    #: Number of the table of the paper whose layout is used instead of `by`.
    paper: int | None = None
    #: True appends the published rows.
    published: bool = False
    #: Name of the method that the robustness table counts from, or that is the ceiling.
    base: str | None = None
    #: Capture folders, for severities and tables that look at predictions.
    captures: Sequence[str | os.PathLike[str]] = ()


# Tables that look at predictions again.
_PIXEL_TABLES = {"novelty": novelty_table, "outline": outline_table, "sharpness": sharpness_table}
#: Tables that show each method, settings and seed once.
_ONCE = ("rank", "discrimination", "cost", "seeds", "robustness", "free-view", "clean-share")


def make_table(request: TableRequest) -> Table:
    """Make the table."""
    number = request.paper
    if number is None and request.published:
        if request.by not in PAPER_OF:
            raise UsageError(
                f"the paper publishes no numbers for the table {request.by!r}",
                field="--published",
                remedy=f"It does for {', '.join(PAPER_OF)}, and for --paper 3 to 10.",
            )
        number = PAPER_OF[request.by]
    if number in (1, 2):
        return fact_table(number)
    if not request.paths and not (number and request.published):
        raise UsageError("results are needed", field="RESULTS")
    return _paper(number, request) if number else _ours(request)


def _ours(request: TableRequest) -> Table:
    sources = read_sources(request.paths, repeats=request.by not in _ONCE)
    if request.by == "clean-share":
        # Captures at several shares are different data, which is what the table is about.
        results = [source.results for source in sources]
        table = clean_share_table(results, find_captures(results, request.captures))
        return add_isolation_note(table, results)
    shown: list[DataGroup] = []
    tables: list[Table] = []
    refused: list[UsageError] = []
    for group in data_groups(sources, oracles=request.by == "robustness"):
        try:
            results = [source.results for source in group.sources]
            tables.append(add_isolation_note(_group_table(group.sources, request), results))
            shown.append(group)
        except UsageError as error:
            # Such as captures of unknown severity; other data may have what the table needs.
            refused.append(error)
    if not tables:
        raise refused[0]
    table = stacked(shown, tables)
    left = [str(error) for error in refused]
    return replace(table, notes=(*table.notes, *(f"Left out: {text}" for text in left)))


def _group_table(sources: Sequence[ResultsSource], request: TableRequest) -> Table:
    """Return the table of results on the same data."""
    results, by = [source.results for source in sources], request.by
    match by:
        case "robustness":
            return robustness_table(sources, request.base)
        case "rank":
            return add_validation_note(rank_table(group_runs(results)), results)
        case "discrimination":
            return discrimination_table(group_runs(results), request.base)
        case "free-view":
            return free_view_table(results)
        case "bias":
            return bias_table(sources, find_captures(results, request.captures))
        case "severity":
            table = severity_table(sources, find_captures(results, request.captures))
        case "novelty" | "outline" | "sharpness":
            captures = open_captures_of(results, request.captures)
            table = _PIXEL_TABLES[by](sources, captures)
        case "seeds":
            table = seeds_table(sources)
        case "cost":
            table = cost_table(group_runs(results))
        case _:
            table = all_tables(results)[by]
    if by not in ("seeds", "cost", "discrimination"):
        table = over_seeds(table, results)
    sentence = winner_note(results) if by in VERDICTS else None
    return replace(table, notes=(sentence, *table.notes)) if sentence else table


def _paper(number: int, request: TableRequest) -> Table:
    sources = read_sources(request.paths)
    results = [source.results for source in sources]
    same_data(results)
    # Table 9 has a row for each capture, and ranks nothing.
    if number != 9 and len({data_key(one) for one in results}) > 1:
        raise UsageError(
            "results on other data, frames or protocols do not stand in one table",
            field="RESULTS",
            remedy="Give results on the same captures; `--by paper` shows several data apart.",
        )
    runs = group_runs(results)
    marks = _marks(request.paths) if number == 6 else None
    if number == 6 and runs and not marks:
        raise UsageError(
            "table 6 is made of an ablation",
            field="RESULTS",
            remedy="Give the folder that `hwp-bench ablate` wrote.",
        )
    if number == 10:
        table = seeds_layout(runs, request.published)
    elif number == 9:
        table = _bias_layout(sources, request)
    else:
        table = layout_table(LAYOUTS[number], runs, request.published, marks)
    return add_isolation_note(table, results)


def _bias_layout(sources: Sequence[ResultsSource], request: TableRequest) -> Table:
    measured = [set(source.results.metrics) for source in sources]
    names = tuple(
        name
        for name in (*METRIC_OF.values(), DISTANCE)
        if all(name in known for known in measured)
        or (request.published and name in METRIC_OF.values())
    )
    if not sources:
        return bias_layout([], names, [], request.published)
    captures = find_captures([source.results for source in sources], request.captures)
    table = bias_table(sources, captures, names)
    # The paper has no rank correlation, the last column.
    rows = [row[:-1] for row in table.rows]
    notes = [note for note in table.notes if note != RANK_NOTE]
    return bias_layout(rows, names, notes, request.published)


def _marks(paths: Sequence[str | os.PathLike[str]]) -> Marks:
    """Return the components of each variant of the ablations among some paths."""
    marks: dict[str, dict[str, bool]] = {}
    for path in paths:
        place = Path(path)
        file = place / ABLATION if place.is_dir() else place
        if file.name != ABLATION or not file.is_file():
            continue
        record = read_json(file)
        try:
            components = [item for item in record["switches"] if not item["alternative"]]
            for variant in record["variants"]:
                thrown = variant["thrown"]
                title = read_results(inside(file.parent, variant["results"][0])).method.title
                marks[title] = {item["title"]: item["name"] not in thrown for item in components}
        except (KeyError, TypeError, IndexError) as error:
            raise BadResult("does not list its variants", where=file, field="variants") from error
    return marks
