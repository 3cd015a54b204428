"""Several comparisons at once: Holm's adjustment and tie groups."""

from __future__ import annotations

from collections.abc import Mapping, Sequence


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p-values so that the chance of any false finding stays at the level.

    Args:
        p_values: of the comparisons of one family, in any order.

    Returns:
        The adjusted values, in the same order, at most 1.

    Source: Holm, A simple sequentially rejective multiple test procedure, 1979.
    """
    order = sorted(range(len(p_values)), key=lambda index: p_values[index])
    adjusted = [1.0] * len(p_values)
    running = 0.0
    for rank, index in enumerate(order):
        running = max(running, min(1.0, (len(p_values) - rank) * p_values[index]))
        adjusted[index] = running
    return adjusted


def tie_groups(count: int, different: Mapping[tuple[int, int], bool]) -> list[str]:
    """Return letters such that two items share one exactly where they are not told apart.

    Args:
        count: number of items, best first.
        different: for each pair (i, j), i < j, whether the two are told apart.

    Returns:
        The letters of each item: `a`, `ab`, `b`, ...

    Source: insert and absorb, Piepho, An algorithm for a letter-based representation of all
    pairwise comparisons, 2004.
    """
    groups = [frozenset(range(count))]
    for first, second in sorted(pair for pair, apart in different.items() if apart):
        split: list[frozenset[int]] = []
        for group in groups:
            both = first in group and second in group
            split += [group - {first}, group - {second}] if both else [group]
        groups = [
            group
            for place, group in enumerate(split)
            if not any(
                group < other or (group == other and place > index)
                for index, other in enumerate(split)
            )
        ]
    groups.sort(key=sorted)
    return [
        "".join(_letter(place) for place, group in enumerate(groups) if item in group)
        for item in range(count)
    ]


def _letter(place: int) -> str:
    """Return `a` to `z`, then `a1`, `b1`, ..."""
    return chr(ord("a") + place % 26) + (str(place // 26) if place >= 26 else "")
