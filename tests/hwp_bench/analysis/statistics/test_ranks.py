"""Ranks with intervals, and who wins. Oracles: constructed scores, counting, simulation."""

from __future__ import annotations

import numpy as np
import pytest
from made_results import made_results

from hwp_bench.analysis.statistics.compare import compare
from hwp_bench.analysis.statistics.pairing import MACRO, group_runs
from hwp_bench.analysis.statistics.ranks import rank_methods, turned, verdict


def runs_of(means: dict[str, float], *, spread: float = 0.3, seed: int = 0, captures: int = 8):
    """Methods with these means; each capture moves each method by its own amount."""
    drawn = np.random.default_rng(seed).normal(0, spread, (len(means), captures))
    # The captures' amounts average to zero, so that the means are exact.
    drawn -= drawn.mean(axis=1, keepdims=True)
    return group_runs(
        [
            made_results(
                name,
                lambda c, f, s, i=index, m=mean: m + drawn[i, c] + 3 * c,
                captures=captures,
            )
            for index, (name, mean) in enumerate(means.items())
        ]
    )


def test_methods_far_apart_have_sure_ranks() -> None:
    ranking = rank_methods(runs_of({"b": 25.0, "a": 30.0, "c": 20.0}), "psnr", resamples=500)
    found = [(r.standing.label, r.rank, r.best, r.worst) for r in ranking.ranks]
    assert found == [("A", 1, 1, 1), ("B", 2, 2, 2), ("C", 3, 3, 3)]
    assert ranking.ranks[0].behind is None
    assert ranking.ranks[2].behind.value == pytest.approx(-10.0)
    text = verdict(ranking)
    assert text.startswith("A wins with PSNR ")
    assert "+5.00 dB against B, the next (95 % interval +4." in text


def test_ties_are_said_and_share_their_interval() -> None:
    ranking = rank_methods(
        runs_of({"a": 30.02, "b": 30.0, "c": 20.0}, spread=1.0), "psnr", resamples=500
    )
    found = [(r.standing.label, r.best, r.worst, r.standing.ties) for r in ranking.ranks]
    assert found == [("A", 1, 2, "a"), ("B", 1, 2, "a"), ("C", 3, 3, "b")]
    text = verdict(ranking)
    assert text.startswith("No clear winner: A leads")
    assert "is tied with B (not significantly different" in text


def test_where_smaller_is_better_the_smallest_wins() -> None:
    """The oriented distance of `made_results` is 1 - PSNR / 100."""
    ranking = rank_methods(runs_of({"b": 25.0, "a": 30.0}), "oriented_distance", resamples=500)
    assert [r.standing.label for r in ranking.ranks] == ["A", "B"]
    assert [(r.best, r.worst) for r in ranking.ranks] == [(1, 1), (2, 2)]
    text = verdict(ranking)
    assert "A wins with Oriented distance" in text
    assert "-0.0500 against B" in text
    assert "P(better) 1.000" in text or "P(better) 0.999" in text


def test_one_method_or_one_capture_wins_nothing_surely() -> None:
    assert "nothing is compared with it" in verdict(rank_methods(runs_of({"a": 1.0}), "psnr"))
    same = [made_results(name, lambda c, f, s: 20.0, captures=1) for name in "ab"]
    text = verdict(rank_methods(group_runs(same), "psnr", resamples=200))
    assert "on one capture, which speaks of no other" in text
    assert "wins" not in text


def test_uneven_seeds_are_named() -> None:
    rows = [made_results("a", lambda c, f, s: 30.0 + s + c % 2, seed=s) for s in (0, 1)]
    rows.append(made_results("b", lambda c, f, s: 20.0 + c))
    ranking = rank_methods(group_runs(rows), "psnr", resamples=200)
    assert ranking.ranks[0].standing.mean == pytest.approx(31.0)
    assert "+9.00 dB against B, the next" in verdict(ranking)
    assert "over the seeds that both have" in verdict(ranking)


def test_only_the_asked_scope_is_compared_with_the_same_numbers() -> None:
    runs = runs_of({"a": 30.0, "b": 29.0, "c": 28.5})
    every = [item for item in compare(runs, "psnr", resamples=300) if item.scope == MACRO]
    assert compare(runs, "psnr", resamples=300, scope=MACRO) == every
    estimate = every[0].estimate
    assert turned(turned(estimate)) == estimate
    assert turned(estimate).low == -estimate.high


def drawn_runs(means: dict[str, float], random: np.random.Generator):
    """One experiment: eight captures, each moves each method by its own random amount."""
    drawn = random.normal(0, 0.4, (len(means), 8))
    return group_runs(
        [
            made_results(
                name, lambda c, f, s, i=index, m=mean: m + drawn[i, c], captures=8, frames=1
            )
            for index, (name, mean) in enumerate(means.items())
        ]
    )


def test_each_interval_holds_as_often_as_it_says() -> None:
    """Simulation: means drawn around known ones; 95 % less three standard deviations of 80."""
    means = {"a": 30.0, "b": 29.6, "c": 29.6, "d": 28.0}
    # Ranks that are true: b and c are equal, so either order of them is.
    wanted = {"A": {1}, "B": {2, 3}, "C": {2, 3}, "D": {4}}
    random = np.random.default_rng(3)
    held = dict.fromkeys(wanted, 0)
    for repeat in range(80):
        ranking = rank_methods(drawn_runs(means, random), "psnr", resamples=200, seed=repeat)
        for r in ranking.ranks:
            true = wanted[r.standing.label]
            held[r.standing.label] += r.best <= min(true) and max(true) <= r.worst
    assert min(held.values()) >= 80 * (0.95 - 3 * (0.95 * 0.05 / 80) ** 0.5), held


def test_equal_methods_are_seldom_called_winners() -> None:
    """Simulation: six equal methods. At most 5 %, and three standard deviations of 80, may win."""
    random = np.random.default_rng(5)
    means = dict.fromkeys("abcdef", 30.0)
    won = sum(
        " wins with " in verdict(rank_methods(drawn_runs(means, random), "psnr", resamples=200))
        for _ in range(80)
    )
    assert won <= 80 * (0.05 + 3 * (0.05 * 0.95 / 80) ** 0.5)


def test_the_winner_is_told_where_all_pairs_at_once_tell_less() -> None:
    """Ten methods, 45 pairs: the leader's nine pairs suffice, Holm over all pairs does not."""
    means = {"a": 31.0} | {name: 30.0 + 0.01 * place for place, name in enumerate("bcdefghij")}
    ranking = rank_methods(runs_of(means, spread=0.42), "psnr", resamples=500)
    first = ranking.ranks[0]
    assert verdict(ranking).startswith("A wins with PSNR ")
    assert (first.best, first.worst) == (1, 1)
    assert any(set(first.standing.ties) & set(r.standing.ties) for r in ranking.ranks[1:])
