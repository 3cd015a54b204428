"""Comparing results. Oracles: known differences put into made results; arithmetic."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_results import made_results

from hwp_bench.analysis.compare import (
    compare,
    holm,
    macro_by_seed,
    rank_methods,
    standings,
    tie_groups,
    turned,
    verdict,
)
from hwp_bench.analysis.pairing import MACRO, group_runs, refuse_unlike, scopes
from hwp_bench.base.errors import UsageError
from hwp_bench.cli.main import main
from hwp_bench.metrics.score import aggregate
from hwp_bench.results import Results, write_results
from hwp_bench.results.schema import score_rows


def noise(capture: int, frame: int, seed: int) -> float:
    """Difficulty of a frame, the same for every method."""
    return float(20 + 3 * np.sin(7 * capture) + np.cos(frame))


def better_by(gain: float):
    return lambda c, f, s: noise(c, f, s) + gain * (1 + 0.1 * np.sin(5 * c + f + s))


def test_a_difference_is_found_and_signed() -> None:
    runs = group_runs([made_results("mine", better_by(2)), made_results("plain", noise)])
    found = compare(runs, "psnr", resamples=2000)
    assert [item.scope for item in found] == [
        "macro", "single", "interacting", "illumination", "motion_blur",
    ]  # fmt: skip
    macro = found[0]
    assert macro.estimate.value == pytest.approx(2, abs=0.2)
    assert 1.5 < macro.estimate.low < macro.estimate.value < macro.estimate.high < 2.5
    assert macro.better > 0.99
    assert macro.estimate.captures == 4
    # A smaller distance is better, so the first is still the better one.
    distance = compare(runs, "oriented_distance", resamples=2000)[0]
    assert distance.estimate.value == pytest.approx(-0.02, abs=0.002)
    assert distance.better > 0.99


def test_perturbations_are_adjusted_together() -> None:
    runs = group_runs([made_results("mine", better_by(2)), made_results("plain", noise)])
    found = {item.scope: item for item in compare(runs, "psnr", resamples=2000)}
    pair = [found["illumination"], found["motion_blur"]]
    smaller, larger = sorted(item.estimate.p for item in pair)
    assert sorted(item.p_adjusted for item in pair) == pytest.approx(
        [2 * smaller, max(2 * smaller, larger)]
    )
    assert found["single"].p_adjusted is None


def test_equal_methods_tie_and_an_unequal_one_stands_apart() -> None:
    def similar(c: int, f: int, s: int) -> float:
        return noise(c, f, s) + 0.05 * (-1) ** c

    made = [
        made_results("plain", noise),
        made_results("best", better_by(5)),
        made_results("twin", similar),
    ]
    runs = group_runs(made)
    found = standings(runs, "psnr", compare(runs, "psnr", resamples=2000))
    assert {item.label: item.ties for item in found} == {"Best": "a", "Plain": "b", "Twin": "b"}
    assert found[0].label == "Best"


def test_seeds_of_one_method_are_one_method() -> None:
    def seeded(c: int, f: int, s: int) -> float:
        return noise(c, f, s) + s

    made = [made_results("mine", seeded, seed=s) for s in (2, 0, 1)]
    runs = group_runs([*made, *(made_results("plain", noise, seed=s) for s in (1, 2))])
    assert [run.label for run in runs] == ["Mine", "Plain"]
    found = compare(runs, "psnr", resamples=500)
    assert found[0].estimate.value == pytest.approx(1.5)
    first = standings(runs, "psnr", found)[0]
    assert (first.label, first.seeds, first.seed_deviation) == (
        "Mine",
        (0, 1, 2),
        pytest.approx(1.0),
    )
    with pytest.raises(UsageError, match="two results are of Mine with seed 2"):
        group_runs([made[0], made[0]])
    with pytest.raises(UsageError, match="have no seed in common"):
        compare(group_runs([made[1], made_results("plain", noise, seed=1)]), "psnr")


def test_the_macro_mean_is_that_of_the_tables() -> None:
    results = made_results("mine", noise, captures=3)
    run = group_runs([results])[0]
    table = aggregate(score_rows(results)).overall.macro["psnr"]
    assert macro_by_seed(run, "psnr") == pytest.approx([table], abs=1e-12)
    assert scopes(results)["macro"] == {"capture0": 0.5, "capture1": 0.5, "capture2": 1.0}
    bare = replace(results, captures=[replace(c, perturbations=[]) for c in results.captures])
    assert list(scopes(bare)) == ["macro", "single", "interacting"]
    assert set(scopes(bare)["macro"].values()) == {1.0}


def changed(**fields: object) -> Results:
    results = made_results("other", noise)
    return replace(results, captures=[replace(c, **fields) for c in results.captures])


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        (made_results("other", noise, captures=3), r"not evaluated on the same captures \(cap"),
        (changed(digest="e"), "on different data under the name capture0"),
        (changed(digest="e", made_by="video 2"), "not stated, and by video 2"),
        (changed(split_digest="e"), "on different splits under the name capture0"),
        (made_results("other", noise, frames=5), "on different test frames under"),
        (made_results("other", noise, protocols={"hwp-v1": {}}), r"different protocols \(hwp-v1"),
        (replace(changed(), frames="clean"), r"training frames \(perturbed and clean\)"),
    ],
    ids=["captures", "data", "importer", "split", "frames", "protocol", "choice"],
)
def test_what_differs_in_more_than_the_method_is_refused(other: Results, reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        refuse_unlike(group_runs([made_results("plain", noise), other]))


def test_labels_are_told_apart() -> None:
    base = made_results("mine", noise)
    budget = {"seconds": 60.0, "steps": None}
    labels = [run.label for run in group_runs([base, replace(base, budget=budget)])]
    assert labels == ["Mine (default)", "Mine (default, 60 s)"]
    other = replace(base, method=replace(base.method, settings={"steps": 11}))
    labels = [run.label for run in group_runs([base, other])]
    assert labels == ["Mine (steps = 10)", "Mine (steps = 11)"]
    code = replace(base, method=replace(base.method, digest="d" * 64))
    assert [run.label for run in group_runs([base, code])][1] == "Mine (default, dddddddd)"


def test_a_limit_of_steps_that_seconds_lift_is_not_told() -> None:
    base = made_results("mine", noise)
    given = [replace(base, budget={"seconds": s, "steps": 100_000}) for s in (16.0, 64.0)]
    assert [run.label for run in group_runs(given)] == [
        "Mine (default, 16 s)",
        "Mine (default, 64 s)",
    ]


def test_other_files_that_a_method_was_shown_make_another_method() -> None:
    def shown(letter: str, place: str, seed: int = 0) -> Results:
        made = made_results("mine", noise, seed=seed)
        captures = [replace(one, exposed=letter * 64) for one in made.captures]
        method = replace(made.method, settings={"regions": f"sam:{place}"})
        return replace(made, method=method, captures=captures)

    runs = group_runs([shown("a", "/a/sam.pth"), shown("b", "/a/sam.pth")])
    assert [run.label for run in runs] == [
        "Mine (default, files aaaaaaaa)",
        "Mine (default, files bbbbbbbb)",
    ]
    assert len(group_runs([shown("a", "/a/sam.pth"), shown("b", "/a/sam.pth", 1)])) == 2
    # Their place is another on every machine.
    (run,) = group_runs([shown("a", "/a/sam.pth"), shown("a", "/srv/sam.pth", 1)])
    assert sorted(run.seeds) == [0, 1]


def test_the_command_prints_tables_and_json_and_refuses(tmp_path: Path, capsys) -> None:
    paths = []
    for name, gain in (("mine", 2.0), ("plain", 0.0)):
        write_results(tmp_path / name / "results.json", made_results(name, better_by(gain)))
        paths.append(str(tmp_path / name))
    assert main(["compare", *paths, "--resamples", "500"]) == 0
    shown = capsys.readouterr().out
    assert "PSNR: differences" in shown
    assert "Motion" in shown
    assert main(["compare", *paths, "--resamples", "500", "--json"]) == 0
    value = json.loads(capsys.readouterr().out)
    assert value["psnr"]["methods"][0]["label"] == "Mine"
    assert value["psnr"]["differences"][0]["estimate"]["low"] > 1
    assert main(["compare", *paths, "--format", "md", "--metric", "psnr"]) == 0
    assert capsys.readouterr().out.count("**PSNR: ") == 2
    assert main(["compare", paths[0]]) == 2
    assert "only one method" in capsys.readouterr().err
    assert main(["compare", *paths, "--metric", "ssim"]) == 2
    write_results(tmp_path / "b" / "results.json", changed(digest="e"))
    assert main(["compare", paths[0], str(tmp_path / "b")]) == 2
    error = capsys.readouterr().err
    assert "different data under the name capture0" in error
    assert error.count("\n") == 2


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


def test_a_leader_that_common_seeds_contradict_is_no_clear_one() -> None:
    """A's other seeds lift its mean above B's; with the seed that both have B is better."""
    rows = [made_results("a", lambda c, f, s: 28.0 + 9 * s + c % 2, seed=s) for s in (0, 1)]
    rows.append(made_results("b", lambda c, f, s: 30.0 + c % 2))
    ranking = rank_methods(group_runs(rows), "psnr", resamples=200)
    found = [(r.standing.label, r.rank, r.best, r.worst) for r in ranking.ranks]
    assert found == [("A", 1, 1, 2), ("B", 2, 1, 2)]
    text = verdict(ranking)
    assert text.startswith("No clear winner: A leads")
    assert text.endswith("and is significantly behind B over the seeds that both have.")
    assert "tied" not in text
    # As many seeds, but others.
    rows = [made_results("a", lambda c, f, s: 30.0 + c % 2, seed=s) for s in (0, 1)]
    rows += [made_results("b", lambda c, f, s: 20.0 + c, seed=s) for s in (1, 2)]
    ranking = rank_methods(group_runs(rows), "psnr", resamples=200)
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


def test_holm_by_hand() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_holm_lies_between_plain_and_bonferroni(values: list[float]) -> None:
    for value, adjusted in zip(values, holm(values), strict=True):
        assert value <= adjusted <= min(1, value * len(values)) + 1e-12


def test_letters_of_a_chain() -> None:
    apart = {(0, 1): False, (1, 2): False, (0, 2): True}
    assert tie_groups(3, apart) == ["a", "ab", "b"]
    assert tie_groups(3, dict.fromkeys(combinations(range(3), 2), True)) == ["a", "b", "c"]
    assert tie_groups(3, {}) == ["a", "a", "a"]


@given(
    st.integers(2, 7).flatmap(
        lambda n: st.tuples(st.just(n), st.sets(st.sampled_from(list(combinations(range(n), 2)))))
    )
)
def test_two_items_share_a_letter_exactly_where_they_are_not_told_apart(case) -> None:
    count, different = case
    pairs = list(combinations(range(count), 2))
    letters = tie_groups(count, {pair: pair in different for pair in pairs})
    assert all(letters)
    for first, second in pairs:
        shared = bool(set(letters[first]) & set(letters[second]))
        assert shared == ((first, second) not in different)


def test_equal_means_share_the_smaller_rank() -> None:
    levels = {"a": 30.0, "b": 30.0, "c": 20.0}
    made = [
        made_results(name, lambda c, f, s, level=level: level + c) for name, level in levels.items()
    ]
    ranking = rank_methods(group_runs(made), "psnr", resamples=200)
    found = [(row.standing.label, row.rank, row.best, row.worst) for row in ranking.ranks]
    assert found == [("A", 1, 1, 2), ("B", 1, 1, 2), ("C", 3, 3, 3)]
