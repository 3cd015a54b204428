"""Which rows of a table can be ranked together, so that an odd row takes no rank from others."""

from __future__ import annotations

from collections.abc import Sequence

from hwp_bench.analysis.statistics.pairing import same_but_seed
from hwp_bench.leaderboard.board_rows import BoardRow
from hwp_bench.leaderboard.records import LEVELS


def rankable(rows: Sequence[BoardRow]) -> tuple[list[BoardRow], str]:
    """Choose the rows that can be ranked with each other.

    Ranks come from differences by pairs over the seeds that two rows share. Left out are

    - rows that lack a part of their suite;
    - all rows but one of the same run: the one that was checked furthest stays, then the first by
      name;
    - rows without a seed that others have: rows with the seed that most rows have stay (of several
      the smallest), and of the others those that share a seed with every row that stays.

    Args:
        rows: of one suite and one version of the protocol.

    Returns:
        Those that stay, in the order given, and a sentence that names the whole rows that do not;
        empty where there are none.
    """
    whole = [row for row in rows if row.whole]
    if not whole:
        return [], ""
    single = _one_of_each_run(whole)
    common = _most_common_seed(single)
    stay = [row for row in single if common in row.seeds]
    for row in single:
        if row not in stay and all(set(row.seeds) & set(other.seeds) for other in stay):
            stay.append(row)
    parts = []
    twins = _names([row for row in whole if row not in single])
    if twins:
        parts.append(f"No rank for a second entry of the same run: {twins}.")
    apart = _names([row for row in single if row not in stay])
    if apart:
        parts.append(
            f"No rank for rows without the seed {common}, which most rows have, and without a "
            f"seed in common with every other row: {apart}."
        )
    return [row for row in rows if row in stay], " ".join(parts)


def _one_of_each_run(rows: Sequence[BoardRow]) -> list[BoardRow]:
    """Leave out rows that have a run (a state of a method and a seed) of a row before them."""
    order = sorted(rows, key=lambda row: (-LEVELS.index(row.level), row.entries[0].name))
    seen: set[tuple[str, int]] = set()
    kept = []
    for row in order:
        runs = {(same_but_seed(row.first), seed) for seed in row.seeds}
        if not runs & seen:
            kept.append(row)
            seen |= runs
    return [row for row in rows if row in kept]


def _most_common_seed(rows: Sequence[BoardRow]) -> int:
    seeds = sorted({seed for row in rows for seed in row.seeds})
    return max(seeds, key=lambda seed: sum(seed in row.seeds for row in rows))


def _names(rows: Sequence[BoardRow]) -> str:
    return ", ".join(row.entries[0].name for row in rows)
