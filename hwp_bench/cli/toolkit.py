"""Contents of the toolkit, and whether it works here: `list`, `info`, `stability`, `completion`."""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from hwp_bench.base.console import notice
from hwp_bench.base.errors import MissingDependency, UsageError
from hwp_bench.base.files import cache_root
from hwp_bench.base.packages import __version__
from hwp_bench.base.tables import Table, print_table, to_object
from hwp_bench.cli.options import add_json, named_table, print_json
from hwp_bench.cli.program import complete
from hwp_bench.taxonomy import PERTURBATIONS, SUITES, catalogue, perturbation

if TYPE_CHECKING:
    from hwp_bench.stability import Case

_LIST = """examples:
  hwp-bench list
  hwp-bench list metrics
  hwp-bench list scenes
  hwp-bench list captures --json
"""


def _add_list(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _LIST
    text = f"what to list (default: everything): {', '.join(_TOPICS)}"
    parser.add_argument("topic", nargs="?", choices=tuple(_TOPICS), metavar="TOPIC", help=text)
    add_json(parser)


def _list(args: argparse.Namespace) -> int:
    tables = {topic: _TOPICS[topic]() for topic in ([args.topic] if args.topic else _TOPICS)}
    if args.json:
        print_json({topic: to_object(table)["rows"] for topic, table in tables.items()})
    for table in () if args.json else tables.values():
        print_table(table)
    return 0


def _captures() -> Table:
    rows = [
        (one.id, one.hands, one.action, one.device, one.frame_count, ", ".join(one.perturbations))
        for one in catalogue().values()
    ]
    titles = "capture, hands, action, device, frames, perturbations"
    return named_table("Captures of the HWP data set", titles, rows)


def _perturbations() -> Table:
    counts = {
        name: sum(name in entry.perturbations for entry in catalogue().values())
        for name in PERTURBATIONS
    }
    rows = [(name, perturbation(name).description, count) for name, count in counts.items()]
    return named_table("Perturbations", "perturbation, what it does, captures", rows)


def _suites() -> Table:
    from hwp_bench.suites.suite import suite

    rows = []
    for name in SUITES:
        items = suite(name)
        frames = sum(item.frame_count for item in items)
        which = ", ".join(item.id for item in items)
        rows.append((name, len(items), frames, f"{items[0].size} px", which))
    titles = "suite, captures, frames, size, which"
    return named_table("Suites", titles, rows)


def _methods() -> Table:
    from hwp_bench.methods.manifest import installed_methods, shipped_methods

    rows = [
        (
            method.name,
            method.title,
            ", ".join(method.presets),
            ", ".join(method.switches) or "-",
            method.authors or "-",
            method.licence or "-",
            _validation(method.validation),
            method.url or "-",
            method.description,
        )
        for method in [*shipped_methods(), *installed_methods()]
    ]
    titles = (
        "method, title, presets, switches, authors, licence, validation frames, url, description"
    )
    return named_table("Methods that ship with the toolkit or are installed", titles, rows)


def _validation(uses: Sequence[str] | None) -> str:
    return "not declared" if uses is None else ", ".join(uses) or "none"


def _metrics() -> Table:
    from hwp_bench.metrics import METRICS

    rows = [
        (
            metric.name,
            metric.protocol,
            metric.unit or "-",
            "higher" if metric.higher_is_better else "lower",
            metric.penalty,
            f"{metric.description} [{metric.reference}]",
        )
        for metric in METRICS
    ]
    return named_table("Metrics", "metric, protocol, unit, better, penalty, what it measures", rows)


def _scenes() -> Table:
    from hwp_bench.sim.scene_files import known_scenes, load_scene

    rows = [
        (
            *(scene.id, scene.title, scene.hands, scene.action, scene.device, scene.frame_count),
            ", ".join(call.kind for call in scene.effects),
            scene.digest,
        )
        for scene in map(load_scene, known_scenes())
    ]
    titles = "scene, title, hands, action, device, frames, effects, digest"
    return named_table("Scenes of the simulator", titles, rows)


def _parts() -> Table:
    from hwp_bench.hands.poses import gestures
    from hwp_bench.sim.effects import ORDER
    from hwp_bench.sim.props.behind import backdrop_names
    from hwp_bench.sim.props.objects import object_names

    parts = {
        "effects": ORDER,
        "objects": object_names(),
        "gestures": gestures(),
        "backgrounds": backdrop_names(),
    }
    rows = [(part, ", ".join(names)) for part, names in parts.items()]
    return named_table("What scene files can name", "part, names", rows)


_TOPICS = {
    "captures": _captures,
    "perturbations": _perturbations,
    "suites": _suites,
    "methods": _methods,
    "metrics": _metrics,
    "scenes": _scenes,
    "scene-parts": _parts,
}

_STABILITY = """examples:
  hwp-bench dev stability
  hwp-bench dev stability --group splat --backend numba
  hwp-bench dev stability --json > stability.json
"""


def _add_stability(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _STABILITY
    more = "may be repeated"
    for option, name, text in (
        (
            "backend",
            "NAME",
            f"only on this backend ({more}; default: every one that this machine has)",
        ),
        ("group", "NAME", f"only this part of the product ({more}; default: all)"),
        (
            "provider",
            "MODULE:FUNCTION",
            f"more cases, besides those of installed packages ({more})",
        ),
    ):
        parser.add_argument(f"--{option}", action="append", default=[], metavar=name, help=text)
    add_json(parser)


def _stability(args: argparse.Namespace) -> int:
    from hwp_bench.stability import find_cases, run_cases

    cases = find_cases(args.group, args.provider)
    _check_backends(cases, args.backend)
    outcomes = []
    for outcome in run_cases(cases, args.backend):
        outcomes.append(outcome)
        if not outcome.measured.passed:
            notice(f"failed: {outcome.case.name}: {outcome.measured.text}")
    passed = sum(outcome.measured.passed for outcome in outcomes)
    if args.json:
        facts = [
            {
                "group": one.case.group,
                "case": one.case.name,
                "backend": one.backend,
                "must_hold": one.case.must_hold,
                "measured": one.measured.text,
                "passed": one.measured.passed,
                "seconds": round(one.seconds, 4),
            }
            for one in outcomes
        ]
        print_json(facts)
    else:
        rows = [
            (
                f"{one.case.group}: {one.case.name}",
                one.backend,
                one.case.must_hold,
                one.measured.text,
                "yes" if one.measured.passed else "NO",
            )
            for one in outcomes
        ]
        titles = "case, backend, what must hold, measured, pass"
        print_table(named_table("Numerical hard cases", titles, rows))
        print(f"{passed} of {len(outcomes)} passed")
    return 0 if passed == len(outcomes) else 1


def _check_backends(cases: list[Case], asked: list[str]) -> None:
    known = sorted({name for case in cases for name in case.backends if name})
    for name in asked:
        if name not in known:
            raise UsageError(
                f"no case can run on {name!r} here",
                field="--backend",
                remedy=f"This machine has {', '.join(known) or 'no choice of backends'}",
            )


_INFO = """examples:
  hwp-bench info
  hwp-bench info --json

Prints what a report of a problem needs, and draws a small scene with every rasterizer that this
machine has, next to the float64 reference. Exit status 0: every check holds; 1: one does not.
"""


def _add_info(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _INFO
    add_json(parser)


def _info(args: argparse.Namespace) -> int:
    from hwp_bench.results.schema import environment
    from hwp_bench.run.runner import sandbox_problem
    from hwp_bench.stability import run_cases

    refused = sandbox_problem()
    facts = environment()
    packages = {"hwp-bench": __version__, **facts.pop("packages")}
    for name in ("code", "caches"):  # of a result
        del facts[name]
    folder = cache_root()
    facts |= {
        "memory": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "gpu": _graphics(),
        "cache": _from_home(folder),
        "cache_size": _size_of(folder),
        "tracker": _tracker(),
        "sandbox": "available" if refused is None else f"not available ({refused})",
    }
    outcomes = list(run_cases(_quick_cases()))
    passed = all(one.measured.passed for one in outcomes)
    if args.json:
        checks = [
            {
                "check": f"{one.case.group}: {one.case.name}",
                "backend": one.backend,
                "must_hold": one.case.must_hold,
                "measured": one.measured.text,
                "passed": one.measured.passed,
            }
            for one in outcomes
        ]
        print_json({**facts, "packages": packages, "checks": checks})
        return 0 if passed else 1
    for name in ("memory", "cache_size"):
        facts[name] = f"{facts[name] / 2**30:.1f} GiB"
    rows = [(name.replace("_", " "), value or "-") for name, value in facts.items()]
    rows += packages.items()
    for one in outcomes:
        state = "right" if one.measured.passed else f"WRONG, must be: {one.case.must_hold}"
        rows.append((f"{one.case.group} ({one.backend})", f"{state}; {one.measured.text}"))
    for name, value in rows:
        print(f"{name:<31} {value}")
    return 0 if passed else 1


def _size_of(folder: Path) -> int:
    """Bytes of the files in a folder in which others may write and remove meanwhile."""
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):
                total += os.stat(os.path.join(place, name)).st_size
    return total


def _graphics() -> str:
    import torch

    return ", ".join(map(torch.cuda.get_device_name, range(torch.cuda.device_count()))) or "none"


def _from_home(path: Path) -> str:
    """Return a path that does not say who the user is."""
    try:
        home = Path.home()
    except RuntimeError:  # a user without one
        return str(path)
    return f"~/{path.relative_to(home)}" if path.is_relative_to(home) else str(path)


def _tracker() -> str:
    from hwp_bench.tracking.networks import HAND, PALM, models_folder

    there = all((models_folder() / name).is_file() for name in (PALM, HAND))
    networks = "networks are in the cache" if there else "networks are downloaded on first use"
    try:
        return f"ai-edge-litert {metadata.version('ai-edge-litert')}, {networks}"
    except metadata.PackageNotFoundError:
        return f"not installed (extra track); {networks}"


def _quick_cases() -> list[Case]:
    from hwp_bench.stability import find_cases

    try:
        cases = [case for case in find_cases() if case.quick]
    except MissingDependency:  # the toolkit alone, without a package that draws
        return []
    # The reference is what the others are compared with.
    others = [tuple(name for name in case.backends if name != "reference") for case in cases]
    return [replace(case, backends=names) for case, names in zip(cases, others, strict=True)]


#: The arguments and the work of each command, where `main` looks for them.
COMMANDS = {
    "list": (_add_list, _list),
    "info": (_add_info, _info),
    "stability": (_add_stability, _stability),
    "completion": complete("hwp-bench", "hwp_bench.cli"),
}
