"""What tells results of one method apart."""

from __future__ import annotations

from collections.abc import Sequence

from hwp_bench.files import canonical_json
from hwp_bench.results import Results

# Longest text of a value.
_SHOWN = 40


def differing_settings(results: Sequence[Results]) -> list[str]:
    """Return for each result those of its settings in which the results differ.

    Args:
        results: of one method.

    Returns:
        Texts such as `prior = "", steps = 300`, with `default` where a result says nothing; empty
        where all settings are the same.
    """
    tables = [result.method.settings for result in results]
    spelled = [{name: canonical_json(value) for name, value in table.items()} for table in tables]
    names = sorted({name for table in spelled for name in table})
    telling = [name for name in names if len({table.get(name) for table in spelled}) > 1]
    return [
        ", ".join(
            f"{name} = {table[name][:_SHOWN]}" if name in table else f"{name} default"
            for name in telling
        )
        for table in spelled
    ]
