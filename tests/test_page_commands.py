"""Every command on pages of users runs, on small things. Oracle: exit statuses.

`NOT_RUN` lists the commands that are only parsed (`test_docs.py`), each with its reason. In the
others a painted capture takes the place of a suite, and fits take two steps. A command that then
equals one that has run is not run again.
"""

from __future__ import annotations

import itertools
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from test_docs import ROOT, example_commands
from test_pages import CONTRIBUTORS, GENERATED
from tiny_fits import TINY, UNJUDGED

from hwp_bench.capture import Capture
from hwp_bench.cli.main import main
from wildghand.cli.main import main as wildghand

#: Pages whose commands run in a test of their own.
ELSEWHERE = {"data": "test_docs_data.py", "tutorial-method": "test_tutorial.py"}
#: Commands that are only parsed, and why.
NOT_RUN = {
    r"hwp-bench demo": "five minutes; test_demo.py runs it on smaller captures",
    r"hwp-bench (ablate|error-budget) ": "many fits; tests/hwp_bench/evaluation runs toys",
    r"wildghand pretrain ": "hours; tests/wildghand/pretrain",
    r".* (hand|front|side|1_0)\.mp4": "needs the tracker's networks; tests/wildghand/from_video",
    r"hwp-bench data import second-view ": "two videos; test_importers_second_view.py",
    r"hwp-bench data import interhand26m ": "needs InterHand2.6M; test_docs_data.py",
    r"hwp-bench data get ": "downloads; test_docs_data.py and test_suites_real.py",
    r".*=(sam|vgg19):": "needs weights of 0.4 to 2.6 GB",
    r".* frame649\.pth": "needs a file of the authors' code; tests/wildghand/export",
    r".* --prior my_prior|.*=/data/my_prior": "needs a prior; tests/wildghand/pretrain",
    r".* --engine ray:": "needs a cluster; tests/hwp_bench/run/engine",
    r".* --live|wildghand view ": "serves until it is stopped; tests/wildghand/viewer",
    r"hwp-bench sim render --suite ": "renders a suite for minutes",
    r"hwp-bench sim preview .*--stage|hwp-bench dev calibrate ": "minutes; tests/hwp_bench/sim",
    r"hwp-bench dev plan wild-dev ": "renders probes of eight scenes; test_consoles.py",
    r"hwp-bench challenge (make|reveal|check) ": "renders suites; test_sealed_suites.py",
    r".* --preset paper": "the published sizes need a GPU",
    r"hwp-bench evaluate (network-scratch )?plain wildghand ": "as with one of the methods",
    r".* --by (clean-share|novelty)": "needs results of several suites; tests/hwp_bench/report",
    r"hwp-bench curves runs/ablation": "needs an ablation; tests/hwp_bench/evaluation/ablate",
    r"hwp-bench dev docs-results": "changes the pages; test_docs_results.py",
    r"hwp-bench dev stability ": "ten minutes; test_hard_cases.py",
    r"hwp-bench (dev )?leaderboard (submit|confirm|contest) ": "needs entries of whole suites; "
    "tests/hwp_bench/leaderboard",
    r".* --against ": "needs another checkout; test_entries.py",
    r".* (inputs/submission|captures/capture0) ": "needs predictions; test_docs_data.py",
    r"hwp-bench evaluate submission ": "needs predictions; test_publish.py",
    r".* mano/": "needs MANO; test_convert.py",
    r".* --splits 496.json": "needs a clip of 621 frames; test_splits.py",
}
PAGES = {
    page.stem: page
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    if page.stem not in GENERATED | CONTRIBUTORS | ELSEWHERE.keys()
}
RUN = {
    name: [
        words
        for words in example_commands(page)
        if not any(re.match(pattern, " ".join(words)) for pattern in NOT_RUN)
    ]
    for name, page in PAGES.items()
}
#: Options of commands that fit, render or simulate, and what is given in their place.
LENGTH = ("--suite", "--budget", "--seeds", "--steps", "--frame-count", "--size")
SHORT = {
    "evaluate": ["--capture", "my_capture", "--steps", "2"],
    "check-method": ["--capture", "my_capture"],
    "verify": ["--capture", "my_capture"],
    "data inputs": ["--capture", "my_capture"],
    "sim render": ["--frame-count", "20", "--size", "32"],
    "sim preview": ["--frame-count", "10", "--size", "32"],
    "dev plan": ["--frame-count", "10", "--size", "32", "--no-probe"],
    "fit": ["--steps", "2", "--overwrite"],
}


def shortened(words: list[str]) -> list[str]:
    """The words of a command that does the same in seconds."""
    for name, short in SHORT.items():
        if words[1 : 1 + len(name.split())] == name.split():
            kept = [w for n, w in enumerate(words) if not {w, words[n - 1]} & {*LENGTH}]
            if "--capture" in kept:
                short = short[2:]
            tiny = words[2:3] == ["wildghand"]
            settings = {"fit": UNJUDGED, "evaluate": TINY if tiny else {}}.get(name, {})
            sets = (("--set", f"{key}={value}".lower()) for key, value in settings.items())
            return [*kept, *short, *itertools.chain(*sets)]
    return words


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory, make_painted: Callable[[str], Capture]) -> Path:
    """A folder with `my_capture`, `my_avatar`, `my_method`, and runs of two methods."""
    import wildghand

    folder = tmp_path_factory.mktemp("pages")
    capture = make_painted("right")
    shutil.copytree(capture.root, folder / "my_capture")
    wildghand.fit(folder / "my_capture", folder / "my_avatar", steps=2, settings=UNJUDGED)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["new", "my_method"]) == 0
        line = "evaluate plain my_method --capture my_capture --steps 2 --seeds 2 -o runs/both"
        assert main(line.split()) == 0
    return folder


def fill(folder: Path, world: Path, commands: list[list[str]]) -> None:
    """Put into a folder what commands name; the name of a run says of which method it is."""
    for name in ("my_capture", "my_avatar", "my_method"):
        shutil.copytree(world / name, folder / name)
    named = [word for words in commands for n, word in enumerate(words) if words[n - 1] != "-o"]
    for name in {word.removeprefix("runs/") for word in named if word.startswith("runs/")}:
        if name == "*":
            names = {"plain": "plain/seed-0", "mine": "my_method/seed-0"}
        elif "/" in name:
            continue
        elif name in ("first", "hour", "timed", "wt"):
            names = {name: "."}
        else:
            method = "plain" if "plain" in name or name == "a" else "my_method"
            seeds = (0, 1) if name.endswith("*") else (0,)
            names = {name.replace("*", str(seed)): f"{method}/seed-{seed}" for seed in seeds}
        for made, source in names.items():
            shutil.copytree(world / "runs" / "both" / source, folder / "runs" / made)


def test_reasons_and_pages_are_of_commands_that_are_there() -> None:
    lines = [" ".join(words) for page in PAGES.values() for words in example_commands(page)]
    assert [p for p in NOT_RUN if not any(re.match(p, line) for line in lines)] == []
    assert sum(map(len, RUN.values())) > 70
    assert all((ROOT / "tests" / test).is_file() for test in ELSEWHERE.values())


HAS_RUN: set[str] = set()


@pytest.mark.slow
@pytest.mark.usefixtures("machine_code")
@pytest.mark.parametrize("page", [page for page in RUN if RUN[page]])
def test_commands_of_a_page_run(
    page: str, world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(tmp_path, world, RUN[page])
    monkeypatch.chdir(tmp_path)
    for words in RUN[page]:
        program, *rest = shortened(words)
        line = re.sub(r" -o \S+", "", " ".join(rest))
        if line in HAS_RUN:
            continue
        HAS_RUN.add(line)
        made = rest[1] if rest[0] == "new" else rest[rest.index("-o") + 1] if "-o" in rest else ""
        if made and Path(made).is_file():
            Path(made).unlink()
        elif made and Path(made).is_dir():
            shutil.rmtree(made)
        rest = [
            path
            for word in rest
            for path in (sorted(map(str, Path().glob(word))) if "*" in word else [word])
        ]
        assert {"hwp-bench": main, "wildghand": wildghand}[program](rest) == 0, " ".join(words)
