"""The ablation study: runs what is missing of it, and writes its page from the result files.

Run from the repository: `python -m benchmarks.ablation FOLDER` fits and writes `FOLDER/page.md`;
`--page docs/ablation.md` writes the page of the documentation, its pictures into
`docs/pictures/ablation`. `--page-only` fits nothing. A stopped study continues:
its parts are ablations of `hwp-bench ablate`, which takes finished jobs as they are.

Parts: `cross` (DPD x PAO x pre-pass), `paper` and `released` (DPD x PAO in these modes), and
`epochs` (`released` for its own 50 epochs, without a budget), each on each suite; and the cross on
capture folders of a person's own video (`--video`). Seeds are the outer loop, so that a study that
is stopped has whole seeds of all parts. The page says which seeds and captures it rests on.
"""

from __future__ import annotations

import argparse
import datetime
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from hwp_bench.analysis.columns import Filled, score_title, table_of
from hwp_bench.analysis.compare import macro_mean
from hwp_bench.analysis.cost import analyse_cost
from hwp_bench.analysis.pairing import MethodRuns, common_metrics, scopes
from hwp_bench.base.console import notice
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write, read_json, write_json
from hwp_bench.base.packages import checkout_commit
from hwp_bench.base.records import parse_record
from hwp_bench.base.tables import Column, Table, format_table
from hwp_bench.cli.main import main as hwp_bench
from hwp_bench.evaluation.ablate.effects import (
    ScoreEffect,
    ablation_tables,
    cost_effects,
    score_effects,
)
from hwp_bench.evaluation.ablate.runs import AblationRuns, Design, make_design, result_folder
from hwp_bench.leaderboard.pages import with_digest
from hwp_bench.methods.manifest import find_method, read_manifest
from hwp_bench.report.figures import write_cost
from hwp_bench.report.sources import find_captures, read_sources
from hwp_bench.report.study_tables import bias_table
from hwp_bench.report.tables import HEADLINE
from hwp_bench.results import Results
from hwp_bench.results.store import read_unchanged
from hwp_bench.sim.produce.capture import RENDERER, suite

METHOD = "wildghand"
#: What a study is, and was when it was started.
RECORD = "study.json"
#: The metric of gains and of the sentences.
METRIC = HEADLINE[0]
#: The parts on a suite: components that are crossed, the base, and whether seconds are limited.
PARTS: dict[str, tuple[tuple[str, ...], str | None, bool]] = {
    "cross": (("dpd", "pao", "prepass"), None, True),
    "paper": (("dpd", "pao"), "paper", True),
    "released": (("dpd", "pao"), "released", True),
    "epochs": (("dpd", "pao"), "released", False),
}
#: Name of the part, and of the suite, of a person's own video.
VIDEO = "video"
#: Steps that no fit reaches before its seconds are over.
_NO_LIMIT = 1_000_000


@dataclass(frozen=True)
class Study:
    """What was asked for; `study.json` keeps it, and the commits of all starts."""

    suites: tuple[str, ...]
    parts: tuple[str, ...]
    #: Number of seeds.
    seeds: int
    #: Seconds of a fit; None where steps are the limit.
    budget: float | None
    #: Steps of a fit; None where seconds are the limit.
    steps: int | None
    #: Capture folders of real video.
    video: tuple[str, ...] = ()
    #: `COMMIT, DATE` of each start, those of one commit once.
    starts: tuple[str, ...] = ()

    def places(self) -> list[tuple[str, str]]:
        """The suite and the part of each ablation, in the order of the page."""
        found = [(name, part) for name in self.suites for part in PARTS if part in self.parts]
        return found + ([(VIDEO, "cross")] if self.video else [])

    def limits(self, suite_name: str, part: str) -> list[str]:
        """The words that limit a fit."""
        if not PARTS[part][2]:
            return []
        if suite_name != VIDEO and self.budget is not None:
            return ["--budget", f"{self.budget:g}", "--steps", str(_NO_LIMIT)]
        # A budget in seconds takes fewer frames of a long clip; real video keeps all of them.
        return ["--steps", str(self.steps or 700)]


def run(folder: Path, study: Study, jobs: int) -> None:
    """Run what is missing, seed by seed; a part that fails is said by its own ablation."""
    for count in range(1, study.seeds + 1):
        for suite_name, part in study.places():
            components, base, _ = PARTS[part]
            words = ["ablate", METHOD, "--only", *components]
            words += ["--base", base] if base else []
            captures = ["--capture", *study.video, "--preset", "mini"]
            words += captures if suite_name == VIDEO else ["--suite", suite_name]
            words += [*study.limits(suite_name, part), "--seeds", str(count)]
            words += ["--jobs", str(jobs), "-o", str(folder / suite_name / part)]
            notice(f"seed {count - 1}: {suite_name}, {part}")
            if hwp_bench(words) not in (0, 1):
                raise SystemExit(2)


@dataclass(frozen=True)
class Part:
    """The finished parts of one ablation."""

    suite: str
    name: str
    #: None where not one capture has been fitted by all variants.
    ablation: AblationRuns | None
    #: What is not there, or not used; a line each.
    missing: tuple[str, ...]
    #: The command that makes this part alone.
    seconds: str

    @property
    def title(self) -> str:
        """`mini, paper`."""
        return f"{self.suite}, {self.name}"


def read_part(folder: Path, study: Study, suite_name: str, part: str) -> Part:
    """Read a part: the seeds that have all captures in all variants, or else what one seed has."""
    components, base, limited = PARTS[part]
    design = make_design(read_manifest(find_method(METHOD)), (), components, base)
    known = [Path(path).name for path in study.video]
    expected = len(known) if suite_name == VIDEO else len(suite(suite_name))
    found: dict[int, dict[str, Results]] = {}
    shared: dict[int, list[str]] = {}
    for seed in range(study.seeds):
        files = {
            variant.name: folder / suite_name / part / result_folder(variant.name, seed)
            for variant in design.variants
        }
        found[seed] = {
            name: read_unchanged(file)
            for name, file in files.items()
            if (file / "results.json").is_file()
        }
        ids = [[c.id for c in results.captures] for results in found[seed].values()]
        whole = len(ids) == len(design.variants)
        shared[seed] = [i for i in ids[0] if all(i in own for own in ids)] if whole else []
    used = [seed for seed, ids in shared.items() if len(ids) == expected]
    missing = [
        f"seed {seed}: {len(ids)} of {expected} captures in all variants"
        for seed, ids in shared.items()
        if len(ids) < expected
    ]
    if not used:
        best = max(shared, key=lambda seed: len(shared[seed]))
        used = [best] if shared[best] else []
    ablation = _ablation(design, {s: (found[s], shared[s]) for s in used}) if used else None
    text = _limit_text(study, suite_name, limited)
    return Part(suite_name, part, ablation, tuple(missing), text)


def _ablation(design: Design, seeds: dict[int, tuple[dict[str, Results], list[str]]]) -> Any:
    runs = {}
    for variant in design.variants:
        own = {
            seed: replace(
                found[variant.name],
                captures=[c for c in found[variant.name].captures if c.id in ids],
            )
            for seed, (found, ids) in seeds.items()
        }
        runs[variant.name] = MethodRuns(next(iter(own.values())).method.title, own)
    return AblationRuns(design, runs)


def _limit_text(study: Study, suite_name: str, limited: bool) -> str:
    if not limited:
        return "50 epochs"
    if suite_name == VIDEO or study.budget is None:
        return f"{study.steps or 700} steps"
    return f"{study.budget:g} s"


def capture_gains(ablation: AblationRuns) -> Table:
    """Return a row a capture: what each component brings when all others are in, in `METRIC`."""
    runs, full = ablation.runs, list(ablation.runs)[-1]
    names = list(scopes(ablation.any_run.first)["macro"])
    seeds = sorted(ablation.any_run.seeds)

    def means(variant: str) -> np.ndarray:
        return np.array([runs[variant].values(name, METRIC, seeds).mean() for name in names])

    columns: list[Filled] = [
        (Column("Capture"), [*names, "least", "mean"]),
        (Column(f"All in: {score_title(METRIC)}", 2), _ends(means(full))),
    ]
    for item in ablation.design.components:
        gains = means(full) - means(item.variant_name)
        columns.append((Column(f"{item.title} brings", 2), _ends(gains)))
    return table_of("Each capture", columns)


def _ends(values: np.ndarray) -> list[float]:
    return [*values.tolist(), float(values.min()), float(values.mean())]


def summary(part: Part, effects: Sequence[ScoreEffect]) -> str:
    """Say in one sentence what a part shows."""
    assert part.ablation is not None
    runs, design = part.ablation.runs, part.ablation.design
    bare, full = (macro_mean(runs[name], METRIC) for name in (next(iter(runs)), list(runs)[-1]))
    kind = "out" if len(design.components) > 2 else "main"
    told = [
        f"{item.effect} {_signed(item)}"
        for item in effects
        if (item.kind, item.scope, item.metric) == (kind, "macro", METRIC)
    ]
    given = "When the others are in" if kind == "out" else "On average over the other in and out"
    return (
        f"**{part.title}** ({part.seconds} a fit): {full:.2f} dB with all components, "
        f"{bare:.2f} dB without them (macro mean). {given}: {'; '.join(told)} dB."
    )


def _signed(item: ScoreEffect) -> str:
    one = item.estimate
    ends = "" if one.low is None or one.high is None else f" ({one.low:+.2f} to {one.high:+.2f})"
    return f"{one.value:+.2f}{ends}"


def modes_table(parts: Sequence[Part]) -> Table | None:
    """Return a row a suite and mode: the paper's Table 6 in one metric; None without such parts."""
    rows = [part for part in parts if part.ablation and PARTS[part.name][1]]
    if not rows:
        return None
    variants = ("no-dpd+no-pao", "no-pao", "no-dpd", "full")
    scores = [
        [macro_mean(part.ablation.runs[name], METRIC) for name in variants]  # type: ignore[union-attr]
        for part in rows
    ]
    columns: list[Filled] = [
        (Column("Suite"), [part.suite for part in rows]),
        (Column("Mode"), [str(PARTS[part.name][1]) for part in rows]),
        (Column("Length"), [part.seconds for part in rows]),
        *(
            (Column(title, 2), list(values))
            for title, values in zip(
                ("Bare", "DPD", "PAO", "DPD and PAO"), zip(*scores, strict=True), strict=True
            )
        ),
    ]
    note = f"{score_title(METRIC)}, macro mean over perturbations, mean over seeds."
    return table_of("Modes", columns, [note])


def write_page(folder: Path, page: Path, pictures: Path, study: Study) -> None:
    """Write the page of what is there."""
    parts = [read_part(folder, study, *place) for place in study.places()]
    shown = [_shown(folder, part, pictures, page.parent) for part in parts if part.ablation]
    results = [one for part in parts if part.ablation for one in part.ablation.results]
    if not results:
        raise UsageError("holds no result that all variants of a part have", where=folder)
    modes = modes_table(parts)
    template = Path(__file__).with_suffix(".md.j2").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True, autoescape=False
    )
    text = environment.from_string(template).render(
        command=command_of(study),
        starts=study.starts,
        machines=sorted({_machine(one) for one in results}),
        versions=sorted({one.toolkit for one in results}),
        digests=sorted({one.method.digest[:12] for one in results}),
        days=sorted({one.started[:10] for one in results}),
        renderer=RENDERER,
        fits=sum(len(one.captures) for one in results),
        summaries=[item["summary"] for item in shown],
        modes=_markdown(modes) if modes else None,
        crosses=[item for item in shown if not item["base"]],
        bases=[item for item in shown if item["base"]],
        missing=[(part.title, part.missing, bool(part.ablation)) for part in parts if part.missing],
    )
    atomic_write(page, with_digest(text))
    notice(f"page: {page}")


def _shown(folder: Path, part: Part, pictures: Path, root: Path) -> dict[str, Any]:
    """What the template shows of one part."""
    ablation = part.ablation
    assert ablation is not None
    metrics = common_metrics(list(ablation.runs.values()), HEADLINE)
    effects = score_effects(ablation, metrics)
    tables = ablation_tables(ablation, effects, cost_effects(ablation))
    first = ablation.any_run.first
    return {
        "title": part.title,
        "base": ablation.design.base,
        "seconds": part.seconds,
        "captures": [capture.id for capture in first.captures],
        "seeds": sorted(ablation.any_run.seeds),
        "summary": summary(part, effects),
        "missing": part.missing,
        "tables": [
            _markdown(tables[name])
            for name in ("ablation", "perturbations", "gains", "component_cost")
            if name in tables
        ],
        "each": _markdown(capture_gains(ablation)),
        "bias": _bias(folder, part),
        "picture": _picture(folder, part, pictures, root),
    }


def _bias(folder: Path, part: Part) -> str | None:
    """The paper's Table 9 of the variant with all components, first seed; None without weights."""
    assert part.ablation is not None
    seed = min(part.ablation.any_run.seeds)
    place = folder / part.suite / part.name / result_folder(list(part.ablation.runs)[-1], seed)
    sources = read_sources([place])
    try:
        return _markdown(bias_table(sources, find_captures([one.results for one in sources])))
    except UsageError:
        return None


def _picture(folder: Path, part: Part, pictures: Path, root: Path) -> str | None:
    """Draw accuracy against time; returns its path from the page."""
    assert part.ablation is not None
    try:
        analysis = analyse_cost(list(part.ablation.runs.values()), METRIC)
    except UsageError:
        return None
    drawn = write_cost(folder / part.suite / part.name / "cost", analysis)[0]
    pictures.mkdir(parents=True, exist_ok=True)
    target = pictures / f"{part.suite}-{part.name}.png"
    shutil.copyfile(drawn, target)
    return target.relative_to(root).as_posix() if target.is_relative_to(root) else str(target)


def _markdown(table: Table) -> str:
    return format_table(table, "md").strip()


def _machine(result: Results) -> str:
    environment = result.environment
    names = {f"{environment.get('processor', '?')}, {environment.get('cores', '?')} cores"}
    names |= {str(c.device) for c in result.captures if c.device not in (None, "cpu")}
    return ", ".join(sorted(names))


def command_of(study: Study) -> str:
    """Return the command that makes the study."""
    limit = f"--steps {study.steps}" if study.budget is None else f"--budget {study.budget:g}"
    video = " --video FOLDER..." if study.video else ""
    return (
        f"python -m benchmarks.ablation runs/study --suites {' '.join(study.suites)} "
        f"--parts {' '.join(study.parts)} --seeds {study.seeds} {limit}{video} "
        "--page docs/ablation.md"
    )


def _started(folder: Path, asked: Study) -> Study:
    """Put a start on record; the commits of earlier ones stay."""
    path = folder / RECORD
    starts = parse_record(Study, read_json(path), where=path).starts if path.is_file() else ()
    commit = checkout_commit() or "unknown commit"
    day = datetime.datetime.now(datetime.UTC).date().isoformat()
    if not any(start.startswith(f"{commit},") for start in starts):
        starts = (*starts, f"{commit}, {day}")
    study = replace(asked, starts=starts)
    write_json(path, asdict(study))
    return study


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    add = parser.add_argument
    add("folder", type=Path, help="where results are kept")
    add("--suites", nargs="*", default=["mini", "wild-dev"])
    add("--parts", nargs="*", choices=list(PARTS), default=["cross", "paper", "released"])
    add("--video", nargs="*", default=[], metavar="FOLDER", help="capture folders of real video")
    add("--seeds", type=int, default=3, help="number of seeds (default 3)")
    add("--budget", type=float, help="seconds of each fit (default 16)")
    add("--steps", type=int, help="steps of each fit, in place of seconds")
    add("--jobs", type=int, default=1, help="fits at one time")
    add("--page", type=Path, help="page to write (default FOLDER/page.md)")
    add("--page-only", action="store_true", help="fit nothing; take what is there")
    args = parser.parse_args(words)
    if args.budget is not None and args.steps is not None:
        parser.error("--budget and --steps: give one of them")
    if args.seeds < 1:
        parser.error("--seeds: at least 1")
    page = args.page or args.folder / "page.md"
    if args.page_only:
        path = args.folder / RECORD
        study = parse_record(Study, read_json(path), where=path)
    else:
        budget = args.budget or (None if args.steps else 16.0)
        video = tuple(args.video)
        asked = Study(tuple(args.suites), tuple(args.parts), args.seeds, budget, args.steps, video)
        study = _started(args.folder, asked)
        run(args.folder, study, args.jobs)
    write_page(args.folder, page, page.parent / "pictures" / "ablation", study)


if __name__ == "__main__":
    main()
