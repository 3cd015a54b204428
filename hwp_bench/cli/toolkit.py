"""Contents of the toolkit, and whether it works here: `list`, `stability`, `completion`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from hwp_bench.base.console import notice
from hwp_bench.base.errors import UsageError
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


#: The arguments and the work of each command, where `main` looks for them.
COMMANDS = {
    "list": (_add_list, _list),
    "stability": (_add_stability, _stability),
    "completion": complete("hwp-bench", "hwp_bench.cli"),
}
