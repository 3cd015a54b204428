"""Numerical hard cases as data, and the registry that finds them.

A part of the product, or another package, offers its cases through an entry point in the group
`hwp_bench.stability` that names a function without arguments:

    [project.entry-points."hwp_bench.stability"]
    splat = "wildghand.splat.hard_cases:cases"

So the benchmark runs cases of packages that it does not know, and imports none of them before
their cases are needed.
"""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Any, TypeAlias

from hwp_bench.base.errors import HwpError, MissingDependency, UsageError, did_you_mean

#: Entry-point group of functions that return cases.
ENTRY_POINTS = "hwp_bench.stability"


@dataclass(frozen=True)
class Context:
    """The choice that a case is run with."""

    #: The implementation to run it on; empty where a case has no choice of them.
    backend: str = ""


@dataclass(frozen=True)
class Measured:
    """The outcome of a case, before its time is added."""

    #: Whether the statement `must_hold` was true.
    passed: bool
    #: The numbers behind it, in a few words.
    text: str


_Run: TypeAlias = Callable[..., Measured]


@dataclass(frozen=True)
class Case:
    """One hard case."""

    #: Unique within its group.
    name: str
    #: The part of the product that it tests, such as "splat".
    group: str
    #: The statement that must be true, for a person.
    must_hold: str
    #: Runs it. An exception counts as a failure.
    run: Callable[[Context], Measured]
    #: Implementations that this machine has; one empty name where there is no choice.
    backends: tuple[str, ...] = ("",)
    #: Whether it is an ordinary case, which takes a moment, and which `hwp-bench info` runs.
    quick: bool = False


class CaseGroup:
    """The hard cases of one part of the product, which functions join by a decorator.

    Args:
        name: of the group.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._cases: list[Case] = []

    def case(self, name: str, must_hold: str, *values: Any) -> Callable[[_Run], _Run]:
        """Decorator: a case, or one for each value, which stands in its words and is its argument.

        The decorated function takes the value, or the members of a tuple, and returns `Measured`.
        """

        def add(run: _Run) -> _Run:
            for value in values or ((),):
                given = value if isinstance(value, tuple) else (value,)
                words = name.format(*given), must_hold.format(*given)
                self._cases.append(Case(words[0], self._name, words[1], _with(run, given)))
            return run

        return add

    def __call__(self) -> list[Case]:
        """Return every case, in the order in which they joined."""
        return list(self._cases)


def _with(run: _Run, given: tuple[Any, ...]) -> Callable[[Context], Measured]:
    return lambda context: run(*given)


@dataclass(frozen=True)
class CaseOutcome:
    """One case, run on one backend."""

    case: Case
    backend: str
    measured: Measured
    seconds: float


def largest(values: Iterable[float]) -> float:
    """Return the largest of some numbers, at least one, or NaN where one is NaN.

    The built-in `max` leaves out a NaN that is not the first.
    """
    given = list(values)
    return math.nan if any(map(math.isnan, given)) else max(given)


def find_cases(groups: Sequence[str] = (), providers: Sequence[str] = ()) -> list[Case]:
    """Return the cases that packages offer."""
    sources = {point.name: point.value for point in metadata.entry_points(group=ENTRY_POINTS)}
    every = dict.fromkeys([*sources.values(), *providers])
    cases = [case for source in every for case in _load(source)]
    if not cases:
        raise MissingDependency(
            "no installed package offers hard cases",
            remedy="Install the project with `pip install -e .`, or name one with --provider",
        )
    known = list(dict.fromkeys(case.group for case in cases))
    for group in groups:
        if group not in known:
            hint = did_you_mean(group, known)
            raise UsageError(
                f"there is no group {group!r}",
                field="--group",
                remedy=f"{hint} There are {', '.join(known)}".strip(),
            )
    return [case for case in cases if not groups or case.group in groups]


def run_cases(
    cases: Iterable[Case], backends: Sequence[str] = (), clock: Callable[[], float] = time.monotonic
) -> Iterator[CaseOutcome]:
    """Run cases one by one, each on every backend that it has, and yield each outcome."""
    for case in cases:
        for backend in case.backends:
            if backends and backend not in backends:
                continue
            start = clock()
            try:
                measured = case.run(Context(backend))
            except Exception as error:  # an exception is a result too
                measured = Measured(False, f"raised {type(error).__name__}: {error}")
            yield CaseOutcome(case, backend, measured, clock() - start)


def _load(source: str) -> list[Case]:
    module, _, function = source.partition(":")
    try:
        return list(getattr(importlib.import_module(module), function)())
    except (ImportError, AttributeError, TypeError) as error:
        raise HwpError(
            f"cannot be loaded ({type(error).__name__}: {error})",
            where=source,
            remedy='A provider is "module:function" and returns cases',
        ) from error
