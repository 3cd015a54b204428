"""A pytest plugin: a test may be skipped only where `tests/allowed_skips.toml` says so, and why.

Any other skip fails, with what to write into that file. The end of the log counts the skips that
were allowed. It works in workers of pytest-xdist as well: they judge, the main process counts.
"""

from __future__ import annotations

import collections
import fnmatch
import re
import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import pytest

_KEY = pytest.StashKey["Skips"]()
_COLLECTED = "collected_for_skips"


@dataclass(frozen=True)
class AllowedSkip:
    """One entry of the list."""

    #: Ids of tests, without what stands in brackets; `*` stands for anything.
    test: str
    #: What the skip says, as a regular expression that is found in it.
    says: str
    #: Why the test cannot run everywhere.
    why: str
    #: What a machine or call needs so that the test runs.
    runs_when: str

    def names(self, test: str) -> bool:
        """Whether the entry is about a test, or about the file that was skipped as a whole."""
        return fnmatch.fnmatchcase(test.partition("[")[0], self.test)

    def allows(self, test: str, said: str) -> bool:
        """Whether this test may be skipped with these words."""
        return self.names(test) and re.search(self.says, said) is not None

    @property
    def file(self) -> str:
        """The part of `test` that names files."""
        return self.test.partition("::")[0]


def read_allowed(path: Path) -> tuple[AllowedSkip, ...]:
    """Read the list; a project without one allows no skip.

    Raises:
        pytest.UsageError: an entry lacks a field, has another one, or has an empty one.
    """
    if not path.is_file():
        return ()
    rows = tomllib.loads(path.read_text("utf-8")).get("skip", [])
    known = {field.name for field in fields(AllowedSkip)}
    for number, row in enumerate(rows, 1):
        if set(row) != known or not all(isinstance(v, str) and v.strip() for v in row.values()):
            raise pytest.UsageError(f"{path}: entry {number} needs text in {sorted(known)}: {row}")
    return tuple(AllowedSkip(**row) for row in rows)


class Skips:
    """What is allowed, and which tests there are."""

    def __init__(self, path: Path, root: Path) -> None:
        self.path = path
        self.root = root
        self.allowed = read_allowed(path)
        self.collected: set[str] = set()

    def judge(self, report: Any) -> None:
        """Turn the report of a skip that is not allowed into a failure."""
        if not report.skipped or hasattr(report, "wasxfail"):
            return
        said = _said(report)
        if not any(entry.allows(report.nodeid, said) for entry in self.allowed):
            report.outcome = "failed"
            report.longrepr = (
                f"{report.nodeid} was skipped: {said}\n"
                f"No entry of {self.path} allows that. Make it run, or add\n"
                f'  [[skip]]\n  test = "{report.nodeid.partition("[")[0]}"\n'
                f'  says = "{re.escape(said)}"\n  why = "..."\n  runs_when = "..."'
            )

    def unmatched(self) -> list[AllowedSkip]:
        """Entries that name no test, among those whose files were looked at or do not exist."""
        files = {test.partition("::")[0] for test in self.collected}
        return [
            entry
            for entry in self.allowed
            if not any(entry.names(test) for test in self.collected)
            and (
                any(fnmatch.fnmatchcase(file, entry.file) for file in files)
                or not any(self.root.glob(entry.file))
            )
        ]

    def summary(self, reports: list[Any]) -> list[str]:
        """The lines that end the log."""
        counts: collections.Counter[AllowedSkip] = collections.Counter()
        for report in reports:
            allowed = (e for e in self.allowed if e.allows(report.nodeid, _said(report)))
            counts.update([next(allowed)])
        lines = [f"{counts.total()} skipped, as {self.path.name} allows"]
        for entry, count in counts.most_common():
            lines.append(f"{count:5d}  {entry.says}: {entry.why} Runs when: {entry.runs_when}")
        for entry in self.unmatched():
            lines.append(f"{self.path.name}: {entry.test} is the name of no test")
        return lines


def _said(report: Any) -> str:
    words = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    return words.removeprefix("Skipped: ")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option of `.ci/run`."""
    parser.addoption("--skips-to", help="write the number of skips and their reasons to a file")


def pytest_configure(config: pytest.Config) -> None:
    """Read the list once for each process."""
    path = config.rootpath / "tests" / "allowed_skips.toml"
    config.stash[_KEY] = Skips(path, config.rootpath)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(item: pytest.Item) -> Any:
    """Judge the skip of a test."""
    report = yield
    item.config.stash[_KEY].judge(report)
    return report


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Any:
    """Judge the skip of a whole file."""
    report = yield
    skips = collector.config.stash[_KEY]
    if report.skipped:
        skips.collected.add(collector.nodeid)
    skips.judge(report)
    return report


def pytest_itemcollected(item: pytest.Item) -> None:
    """Remember each test, those too that are deselected."""
    item.config.stash[_KEY].collected.add(item.nodeid.partition("[")[0])


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Send the names of the tests from a worker to the main process."""
    output = getattr(session.config, "workeroutput", None)
    if output is not None:
        output[_COLLECTED] = sorted(session.config.stash[_KEY].collected)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take the names from a worker."""
    names = getattr(node, "workeroutput", {}).get(_COLLECTED, ())
    node.config.stash[_KEY].collected.update(names)


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """End the log with the number of skips and their reasons."""
    lines = config.stash[_KEY].summary(terminalreporter.stats.get("skipped", []))
    terminalreporter.section("skips")
    for line in lines:
        terminalreporter.line(line)
    if target := config.getoption("--skips-to"):
        Path(target).write_text("\n".join(lines) + "\n", encoding="utf-8")
