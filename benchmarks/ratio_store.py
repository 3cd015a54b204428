"""The stored ratios of the benchmarks: the file `ratios.json`, and what is in it."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import importlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.files import read_json, write_json
from hwp_bench.base.packages import checkout_commit
from hwp_bench.base.records import Line, number, parse_record
from hwp_bench.results.schema import environment

#: The file.
STORE = Path(__file__).with_name("ratios.json")
#: On another processor than the stored ratio's, tolerances count so many times: caches and vector
#: units differ, so that ratios do too.
ELSEWHERE = 3.0
#: Its format.
SCHEMA: Final = "hwp-ratios/1"


@dataclass(frozen=True)
class Ratio:
    """One number that a benchmark measures: a time as a multiple of another of the same run."""

    #: Its name among those that `measure` returns.
    name: Line
    #: What it was on the benchmark's machine; None until it has been measured.
    ratio: float | None = None
    #: Share by which it may be worse.
    tolerance: float = number(0.25, 0.0, 10.0)
    #: Which direction is better.
    better: Literal["lower", "higher"] = "lower"
    #: Worst value that is kept on any machine; None: the tolerance says.
    limit: float | None = None

    def bound(self, machine: str) -> float:
        """The worst value that is kept.

        Args:
            machine: `same` as the stored ratio's, or `other`.
        """
        if self.limit is not None:
            return self.limit
        if self.ratio is None:
            return math.inf if self.better == "lower" else -math.inf
        grown = 1.0 + self.tolerance * (1.0 if machine == "same" else ELSEWHERE)
        return self.ratio * grown if self.better == "lower" else self.ratio / grown


@dataclass(frozen=True)
class Benchmark:
    """One benchmark: a module with a function `measure`, and the ratios that are kept of it."""

    #: Its name on the command line.
    name: Line
    #: Its module.
    module: Line
    #: The command by which a person sees the same and more.
    command: Line
    #: Arguments of `measure`.
    arguments: dict[str, Any] = field(default_factory=dict)
    #: Whether it takes seconds, so that CI runs it.
    quick: bool = False
    #: Where the ratios were measured.
    machine: Line = ""
    #: Commit and day of the measurement; empty where it was not recorded.
    measured: Line = ""
    #: The ratios.
    ratios: list[Ratio] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not self.module.startswith("benchmarks."):
            raise UsageError(f"{self.module!r} is not a module in benchmarks", field="module")

    def bounds(self) -> dict[str, float]:
        """The worst value of each ratio that is kept on this machine."""
        machine = "same" if self.machine in ("", this_machine()) else "other"
        return {ratio.name: ratio.bound(machine) for ratio in self.ratios}

    def regressions(self, found: Mapping[str, float]) -> list[str]:
        """Names of the ratios that are worse than they may be, not a number, or missing."""
        bounds, worse = self.bounds(), []
        for ratio in self.ratios:
            value = found.get(ratio.name, math.nan)
            bound = bounds[ratio.name]
            if not (value <= bound if ratio.better == "lower" else value >= bound):
                worse.append(ratio.name)
        return worse

    def measure(self) -> Mapping[str, float]:
        """Measure it now."""
        found: Mapping[str, float] = importlib.import_module(self.module).measure(**self.arguments)
        return found


@dataclass(frozen=True)
class _Store:
    """The file."""

    #: `SCHEMA`.
    schema: Literal["hwp-ratios/1"]
    #: The benchmarks.
    benchmarks: list[Benchmark]


def read_store(path: Path = STORE) -> list[Benchmark]:
    """Read the stored ratios.

    Raises:
        BadInput: the file is missing or wrong.
    """
    return parse_record(_Store, read_json(path), where=path, error=BadInput).benchmarks


def write_store(benchmarks: Sequence[Benchmark], path: Path = STORE) -> None:
    """Write them."""
    write_json(path, dataclasses.asdict(_Store(SCHEMA, list(benchmarks))))


def updated(benchmark: Benchmark, found: Mapping[str, float]) -> Benchmark:
    """The benchmark with what was measured here in place of what is stored.

    A ratio that was not measured stays as it is.
    """
    ratios = [
        dataclasses.replace(ratio, ratio=round(found[ratio.name], 4))
        if ratio.name in found
        else ratio
        for ratio in benchmark.ratios
    ]
    here = origin()
    measured = f"{here['commit']}, {here['day']}"
    return dataclasses.replace(benchmark, ratios=ratios, machine=here["machine"], measured=measured)


def origin() -> dict[str, str]:
    """Return where a number is from: the commit, the day, and the processor with its cores."""
    return {
        "commit": checkout_commit(),
        "day": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": this_machine(),
    }


@functools.cache
def this_machine() -> str:
    """The processor and its cores."""
    facts = environment()
    return f"{facts['processor']}, {facts['cores']} cores"
