"""Results in pages. Oracles: means of constructed scores by hand, and texts changed by hand."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from made_entries import complete_results

from benchmarks.video_stages import keep
from hwp_bench.analysis.bootstrap import Estimate
from hwp_bench.base.errors import UsageError
from hwp_bench.cli.main import main
from hwp_bench.leaderboard.entries import make_entry
from hwp_bench.leaderboard.pages import (
    PICTURES,
    Sources,
    _facts,
    _novel_views,
    against_each,
    find_faults,
    verdict_of,
    with_digest,
    write_pages,
)
from hwp_bench.leaderboard.submit import PLACE, add_entries
from hwp_bench.results import write_results

ROOT = Path(__file__).resolve().parents[3]
TYPED = "[generated]\n[definitions]\n[unsourced]\n"


def test_the_pages_say_what_the_files_say() -> None:
    assert find_faults(ROOT) == [], "run hwp-bench dev docs-results"


def test_the_page_names_fits_that_shared_their_core(tmp_path: Path) -> None:
    budget = {"seconds": 64.0, "steps": None}
    made = complete_results("plain", suite_name="mini", budget=budget)
    captures = [
        replace(one, device="cpu", fit_seconds=4.0, cpu_seconds=2.0 if number < 2 else 4.0)
        for number, one in enumerate(made.captures)
    ]
    add_entries(tmp_path / PLACE, [replace(made, captures=captures)])
    (field,) = Sources(tmp_path).fields
    text = _facts(field.rows)
    # Six of eight fits had a core, two a half.
    assert "- **Cores that a fit used**: 0.88 to 0.88" in text
    assert "- **Fits that shared their core**: 2 of 8 (Plain)" in text
    assert "beyond their budget" not in text
    short = replace(made, captures=captures, budget={"seconds": 2.5, "steps": None})
    late = replace(field.rows[0], entries=(make_entry(short),))
    assert "- **Fits beyond their budget**: 8 of 8, up to 4.0 s (Plain)" in _facts([late])


def field_results():
    """Three methods on mini, two seeds, 16 seconds; one more method on a part of it.

    Capture c has 25 + c / 2 dB with WildGHand, 24 + c / 2 with the plain fit, but 30.2 in the last
    one, and 23 + c / 4 with Trimmed; the second seed has 0.2 dB more.
    """

    def plain(number: int) -> float:
        return 30.2 if number == 7 else 24 + number / 2

    scores = {
        "wildghand": lambda number: 25 + number / 2,
        "plain": plain,
        "trimmed": lambda number: 23 + number / 4,
    }
    made = []
    for name, score in scores.items():
        for seed in (0, 1):
            results = complete_results(
                name,
                lambda number, frame, score=score, seed=seed: score(number) + 0.2 * seed,
                suite_name="mini",
                seed=seed,
                budget={"seconds": 16.0, "steps": None},
            )
            made.append(replace(results, method=replace(results.method, title=name.title())))
    return made


# Methods whose tables share a page.
TWO = ("wild", "plain")


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkout with entries, pages whose blocks are empty, and logs of benchmarks."""
    root = tmp_path_factory.mktemp("checkout")
    add_entries(root / PLACE, field_results())
    pages = {
        "README.md": "<!-- results: headline -->\n<!-- end -->\n",
        "docs/field.md": "# The field\n\n<!-- results: field -->\n<!-- end -->\n\nThe end.\n",
        "baselines/wild/README.md": "<!-- results: tuning wild -->\nold\n<!-- end -->\n",
        "docs/two.md": "\n".join(f"<!-- results: tuning {a} -->\n<!-- end -->" for a in TWO),
        "docs/results.toml": TYPED,
        "docs/video.md": "<!-- results: stages -->\n<!-- end -->\n",
        "docs/studies/one.md": "It brings 2.5 dB.\n",
    }
    for name, text in pages.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    fit = {"preset": "smoke", "limit": "9 steps", "seed": 0, "day": "2026-01-02", "machine": "m"}
    rows = [
        ("wild", "", "a", 20.0),
        ("wild", "", "b", 21.0),
        ("wild", "rate=1,power=2", "a", 22.0),
        ("wild", "rate=1,power=2", "b", 24.0),
        ("wild", "rate=3", "a", 30.0),
        ("plain", "", "a", 10.0),
        ("plain", "", "b", 12.0),
        ("plain", "rate=1", "a", 12.0),
    ]
    names = ("method", "trial", "capture", "score")
    lines = [
        json.dumps({**fit, **dict(zip(names, row, strict=True)), "commit": "c"}) for row in rows
    ]
    (root / "benchmarks").mkdir()
    (root / "benchmarks" / "tuning.jsonl").write_text("\n".join(lines) + "\n")
    log = root / "benchmarks" / "video_stages.jsonl"
    keep([video_stages(7.0, quick=False), video_stages(3.0, quick=True)], log)
    keep([video_stages(5.4, quick=False)], log)
    write_pages(root)
    return root


def video_stages(seconds: float, *, quick: bool) -> dict[str, object]:
    """A run of `wildghand fit` of one video, half of which is its fit."""
    stages = {"track": 0.5 * seconds, "fit": 0.5 * seconds}
    made = {"video": "a.mp4", "quick": quick, "frames": 9, "seconds": seconds, "stages": stages}
    return {**made, "commit": "c", "day": "2026-01-02", "machine": "m"}


def cells(text: str, start: str) -> list[str]:
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {start}")]
    return [cell.strip(" *") for cell in line.strip("|").split("|")]


def test_the_field_has_the_means_and_differences_of_the_entries(checkout: Path) -> None:
    page = (checkout / "docs" / "field.md").read_text()
    # The macro mean: each perturbation counts the same, whichever captures it has.
    own = field_results()[0].scores["psnr"] + 0.1
    assert cells(page, "Wildghand")[2] == f"{own:.2f}"
    lead = own - field_results()[2].scores["psnr"] - 0.1
    assert cells(page, "Plain")[3].startswith(f"{lead:+.2f} (")
    assert cells(page, "Trimmed")[4] == "ahead"
    assert "The end.\n" in page
    holm = "(Holm over the 2 pairs)"
    assert f"significantly ahead of 1 of the 2 others, and behind none {holm}." in page
    assert "3 of the 15 methods that ship are complete here" in page
    assert "**Incomplete**: no complete run of " in page
    # 28.5 dB against 30.2 on the last capture; one dB ahead elsewhere.
    assert "on 1 of 8 captures: capture7 (-1.70 dB, Plain)" in page
    assert "- **Seeds**: 0, 1\n" in page
    assert "- **Budget**: 16 s\n" in page


def test_the_headline_has_the_fewest_and_the_most_seeds_and_no_lone_pair(tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text("<!-- results: headline -->\n<!-- end -->\n")
    (tmp_path / "docs" / "results.toml").write_text(TYPED)
    add_entries(tmp_path / PLACE, field_results()[:3])  # WildGHand twice, the plain fit once
    write_pages(tmp_path)
    assert "| mini" not in (tmp_path / "README.md").read_text()
    add_entries(tmp_path / PLACE, field_results()[4:5])
    write_pages(tmp_path)
    assert cells((tmp_path / "README.md").read_text(), "mini")[-1] == "1 to 2"


def test_a_method_ahead_of_each_other_one_is_said_to_be(tmp_path: Path) -> None:
    """Leads of 2 or 4 dB on the plain fit spread more than those of 1 or 1.5 on Trimmed."""
    scores = {"wildghand": (30.0, 0.0), "plain": (28.0, 2.0), "trimmed": (29.0, 0.5)}
    made = [
        complete_results(
            name, lambda number, frame, a=a, b=b: a - b * (number % 2), suite_name="mini"
        )
        for name, (a, b) in scores.items()
    ]
    add_entries(tmp_path / PLACE, made)
    (one,) = Sources(tmp_path).fields
    found = re.escape(one.named["plain"].title)
    assert re.search(
        rf"ahead of all 2 others; least surely of {found}: \+3\.\d\d \(", against_each(one)
    )


def test_how_many_others_are_behind_allows_for_their_number() -> None:
    """Oracle: Holm by hand. 0.02 of one pair is significant, and of two pairs it is 0.04."""

    def said(*p_values: float) -> str:
        rows = [SimpleNamespace(name=f"m{k}", title=f"M{k}") for k in range(len(p_values))]
        leads = {
            f"m{k}": Estimate(value, value - 1.0, value + 1.0, 0.9, p, detectable=1.0, captures=8)
            for k, (p, value) in enumerate(zip(p_values, (-2.0, 2.0, 2.0), strict=False))
        }
        return against_each(SimpleNamespace(others=rows, leads=leads))

    assert "ahead of 0 of the 3 others, and behind none (Holm over the 3" in said(0.02, 0.03, 0.04)
    assert "ahead of 1 of the 3 others, and behind M0 (Holm" in said(0.02, 0.01, 0.30)
    assert "ahead of 0 of the 1 others, and behind M0." in said(0.02)


def test_novel_views_are_compared_over_the_same_clips() -> None:
    def row(*scores: float | None, digest: str = "one") -> SimpleNamespace:
        captures = []
        for number, score in enumerate(scores):
            clip = SimpleNamespace(frames=[SimpleNamespace(scores={"psnr": score})], digest=digest)
            captures.append(SimpleNamespace(id=f"c{number}", free_view=clip if score else None))
        return SimpleNamespace(captures=captures)

    rows = [row(20.0, 30.0, None), row(None, 40.0, None), row(None, None, None)]
    assert _novel_views(rows) == [25.0, None, None]
    assert _novel_views(rows[2:]) == [None]
    rows = [row(20.0, 30.0, digest="other"), row(20.0, 30.0), row(22.0, 30.0)]
    assert _novel_views(rows) == [None, 25.0, 26.0]


def test_a_suite_has_a_picture_that_the_page_shows(checkout: Path) -> None:
    page = (checkout / "docs" / "field.md").read_text()
    (name,) = re.findall(r"!\[.*\]\(pictures/field/(mini-\w{8}\.svg)\)", page)
    picture = checkout / PICTURES / name
    assert picture.read_bytes().startswith(b"<?xml")
    kept = picture.read_bytes()
    picture.unlink()
    assert find_faults(checkout) == [f"{PICTURES}/{name}: is missing"]
    old = picture.with_name("mini-00000000.svg")
    old.write_text("of other numbers")
    assert write_pages(checkout) == [picture]
    assert picture.read_bytes() == kept
    assert not old.exists()


def test_the_first_page_has_a_line_a_suite(checkout: Path) -> None:
    row = cells((checkout / "README.md").read_text(), "mini")
    own, plain = (field_results()[place].scores["psnr"] + 0.1 for place in (0, 2))
    assert row[:4] == ["mini, 8 captures", f"{own:.2f}", f"Plain, {plain:.2f}", f"{plain:.2f}"]
    assert row[5:] == ["3", "16 s", "2"]


def test_stages_of_a_video_are_those_of_its_last_run(checkout: Path) -> None:
    page = (checkout / "docs" / "video.md").read_text()
    assert cells(page, "a.mp4 |") == ["a.mp4", "9", "5", "3", "3", "m, 2026-01-02"]
    assert cells(page, "a.mp4, quick") == [
        "a.mp4, quick",
        "9",
        "3",
        "2",
        "2",
        "m, 2026-01-02",
    ]


def test_trials_have_means_next_to_the_plain_fit(checkout: Path) -> None:
    page = (checkout / "baselines" / "wild" / "README.md").read_text()
    assert "9 steps a fit, preset smoke, seed 0" in page
    assert cells(page, "preset") == ["preset", "20.00", "21.00", "<u>20.50</u>"]
    assert cells(page, "rate=1 power=2") == ["rate=1 power=2", "22.00", "24.00", "23.00"]
    assert cells(page, "rate=3") == ["rate=3", "30.00", "–", "–"]
    assert cells(page, "the plain fit") == ["the plain fit", "10.00", "12.00", "11.00"]
    assert "Commit, day, machine: c, 2026-01-02, m." in page
    assert "old" not in page
    both = (checkout / "docs" / "two.md").read_text()
    assert cells(both, "rate=1 |") == ["rate=1", "12.00", "–", "–"]
    assert both.count("<!-- end -->") == 2
    assert both.index("rate=3") < both.index("<!-- results: tuning plain -->")


@pytest.mark.parametrize("page", ["README.md", "docs/field.md", "baselines/wild/README.md"])
def test_a_number_that_was_changed_by_hand_is_found(
    checkout: Path, page: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["dev", "docs-results", "--check", "--root", str(checkout)]) == 0
    file = checkout / page
    text = file.read_text()
    changed = re.sub(r"\d\.\d\d \|", "9.99 |", text, count=1)
    assert changed != text
    file.write_text(changed)
    assert main(["dev", "docs-results", "--check", "--root", str(checkout)]) == 1
    assert capsys.readouterr().out == f"{page}: a block is not what its source says\n"
    assert main(["dev", "docs-results", "--root", str(checkout)]) == 0
    assert file.read_text() == text


@pytest.mark.parametrize(
    ("text", "faults"),
    [
        ("It brings 2.5 dB.", ["2.5 dB"]),
        ("It brings 2.5 dB ([study](studies/one.md)).", []),
        ("It brings 2.6 dB ([study](studies/one.md)).", ["2.6 dB"]),
        # The end of the study's number.
        ("It brings 5 dB ([study](studies/one.md)).", ["5 dB"]),
        ("See [this](studies/one.md).\n\nIt brings 2.5 dB.", ["2.5 dB"]),
        ("From -1.5 to +2\ndB, and 3 and 4 dB.", ["-1.5 to +2 dB", "3 and 4 dB"]),
        ("At most 100 dB.", []),
        ("No number: dB.", []),
    ],
)
def test_a_decibel_outside_of_blocks_needs_a_source(
    checkout: Path, text: str, faults: list[str]
) -> None:
    page, typed = checkout / "docs" / "page.md", checkout / "docs" / "results.toml"
    page.write_text(text)
    typed.write_text(TYPED.replace("[unsourced]", '"page.md" = ["100 dB"]\n[unsourced]'))
    try:
        found = find_faults(checkout)
    finally:
        page.unlink()
        typed.write_text(TYPED)
    assert [fault.split(": ", 1)[1] for fault in found] == [
        f"{one!r} has no source" for one in faults
    ]


def test_a_page_that_a_program_wrote_is_as_it_was_written(checkout: Path) -> None:
    page, typed = checkout / "docs" / "page.md", checkout / "docs" / "results.toml"
    typed.write_text(TYPED.replace("[def", '"page.md" = "benchmarks/some.py"\n[def'))
    page.write_text(with_digest("It brings 2.5 dB.\n"))
    try:
        assert with_digest(page.read_text()) == page.read_text()
        assert find_faults(checkout) == []
        page.write_text(page.read_text().replace("2.5", "2.6"))
        fault = "docs/page.md: is not as benchmarks/some.py wrote it"
        assert find_faults(checkout) == [fault]
        page.write_text("It brings 2.5 dB.\n")
        assert find_faults(checkout) == [fault]
    finally:
        page.unlink()
        typed.write_text(TYPED)


def test_suites_that_nothing_was_designed_on_come_first(tmp_path: Path) -> None:
    names = ("mini", "smoke", "real-1", "wild-test")
    made = [complete_results("mine", 20.0, suite_name=name) for name in names]
    add_entries(tmp_path / PLACE, made)
    assert [one.suite for one in Sources(tmp_path).fields] == [
        "wild-test",
        "real-1",
        "smoke",
        "mini",
    ]


def test_a_wrong_place_and_a_wrong_block_are_refused(tmp_path: Path, checkout: Path) -> None:
    with pytest.raises(UsageError, match="not a checkout"):
        write_pages(tmp_path)
    page = checkout / "docs" / "page.md"
    page.write_text("<!-- results: weather -->\n<!-- end -->\n")
    with pytest.raises(UsageError, match=r"page\.md.*'weather' is not a block of results"):
        find_faults(checkout)
    page.unlink()


def test_a_verdict_follows_the_interval() -> None:

    told = {(0.1, 2.0): "ahead", (-2.0, -0.1): "behind", (-0.1, 0.1): "not significant"}
    for (low, high), text in told.items():
        assert verdict_of(Estimate((low + high) / 2, low, high, None, None, None, 8)) == text
    assert verdict_of(None) is None


def test_a_folder_of_methods_and_seeds_is_added_in_one_call(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs, entries = tmp_path / "runs", tmp_path / "board" / "entries"
    made = field_results()
    for one in made:
        place = runs / one.method.name / f"seed-{one.seed}"
        place.mkdir(parents=True)
        write_results(place / "results.json", one)
    words = ["dev", "leaderboard", "add", str(runs), "--entries", str(entries)]
    assert main(words) == 0
    assert len(list(entries.glob("*.json"))) == len(made)
    before = {file.name: file.read_bytes() for file in entries.glob("*.json")}
    assert main(words) == 0
    assert {file.name: file.read_bytes() for file in entries.glob("*.json")} == before
    assert main(["leaderboard", "check", "--entries", str(entries)]) == 0
    lacking = replace(made[0], captures=made[0].captures[:-1], seed=2)
    place = runs / "wildghand" / "seed-2"
    place.mkdir()
    write_results(place / "results.json", lacking)
    capsys.readouterr()
    assert main(words) == 1
    assert "capture7" in capsys.readouterr().err
    assert len(list(entries.glob("*.json"))) == len(made)


def test_runs_of_a_video_on_other_machines_are_kept(tmp_path: Path) -> None:
    log = tmp_path / "stages.jsonl"
    first, later = (video_stages(seconds, quick=False) for seconds in (7.0, 5.4))
    keep([first], log)
    keep([{**first, "machine": "another"}], log)
    keep([later], log)
    kept = [json.loads(line) for line in log.read_text("utf-8").splitlines()]
    assert kept == [{**first, "machine": "another"}, later]
