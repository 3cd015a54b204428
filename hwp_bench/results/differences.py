"""What tells results of one method apart."""

from __future__ import annotations

from collections.abc import Sequence

from hwp_bench.base.files import canonical_json
from hwp_bench.results import Results

# Longest text of a value.
_SHOWN = 40


def differing_settings(results: Sequence[Results]) -> list[str]:
    """Return for each result those of its settings in which results of its title differ.

    Returns:
        Texts such as `prior = "", steps = 300`, with `default` where a result says nothing; empty
        where all settings are the same.
    """
    spelled = [
        {name: canonical_json(value) for name, value in result.method.settings.items()}
        for result in results
    ]
    told = []
    for result, mine in zip(results, spelled, strict=True):
        twins = [
            table
            for other, table in zip(results, spelled, strict=True)
            if other.method.title == result.method.title
        ]
        names = sorted({name for table in twins for name in table})
        told.append(
            ", ".join(
                f"{name} = {mine[name][:_SHOWN]}" if name in mine else f"{name} default"
                for name in names
                if len({table.get(name) for table in twins}) > 1
            )
        )
    return told
