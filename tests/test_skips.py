"""The plugin that makes skips fail, in runs of its own. Oracle: what each small project skips."""

from __future__ import annotations

import ast
import fnmatch
from pathlib import Path

import pytest
from skips import read_allowed

ROOT = Path(__file__).resolve().parents[1]
LIST = ROOT / "tests" / "allowed_skips.toml"
WHOLE_FILE = "import pytest\npytest.importorskip('no_such_module')\ndef test_a():\n    pass\n"
IN_A_TEST = (
    "import pytest\n"
    "@pytest.mark.parametrize('n', [1, 2])\ndef test_a(n):\n    pytest.skip('no moon')\n"
    "@pytest.mark.xfail(run=False)\ndef test_b():\n    assert False\n"
    "def test_c():\n    pass\n"
)
PROCESSES = pytest.mark.parametrize("processes", [(), ("-n", "1")], ids=["one", "a worker"])


@pytest.fixture
def project(pytester: pytest.Pytester) -> pytest.Pytester:
    """A project with the plugin."""
    pytester.makeconftest((ROOT / "tests" / "skips.py").read_text("utf-8"))
    pytester.makefile(".ini", pytest="[pytest]\ntestpaths = tests\n")
    (pytester.path / "tests").mkdir()
    return pytester


def write(project: pytest.Pytester, code: str, *entries: str) -> None:
    (project.path / "tests" / "test_x.py").write_text(code)
    rows = [f'[[skip]]\n{entry}\nwhy = "It is day."\nruns_when = "night"\n' for entry in entries]
    (project.path / "tests" / "allowed_skips.toml").write_text("\n".join(rows))


def run(project: pytest.Pytester, *words: str) -> pytest.RunResult:
    return project.runpytest_inprocess(
        "-p", "no:cacheprovider", "-p", "no:hypothesispytest", *words
    )


@PROCESSES
def test_a_skip_that_nobody_named_fails(
    project: pytest.Pytester, processes: tuple[str, ...]
) -> None:
    write(project, IN_A_TEST)
    done = run(project, *processes)
    done.assert_outcomes(passed=1, failed=2, xfailed=1)
    assert done.ret == pytest.ExitCode.TESTS_FAILED
    done.stdout.fnmatch_lines(['  test = "tests/test_x.py::test_a"', "0 skipped, *"])


@PROCESSES
def test_a_named_skip_passes_and_is_counted(
    project: pytest.Pytester, processes: tuple[str, ...]
) -> None:
    write(project, IN_A_TEST, 'test = "tests/test_x.py::test_a"\nsays = "no moon"')
    done = run(project, *processes, "--skips-to", "told.txt")
    done.assert_outcomes(passed=1, skipped=2, xfailed=1)
    assert done.ret == pytest.ExitCode.OK
    told = (project.path / "told.txt").read_text("utf-8").splitlines()
    assert told == [
        "2 skipped, as allowed_skips.toml allows",
        "    2  no moon: It is day. Runs when: night",
    ]
    done.stdout.fnmatch_lines(told)


@PROCESSES
def test_a_file_that_is_skipped_is_a_skip(
    project: pytest.Pytester, processes: tuple[str, ...]
) -> None:
    write(project, WHOLE_FILE)
    done = run(project, *processes)
    assert done.ret not in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)
    done.stdout.fnmatch_lines(["*tests/test_x.py was skipped: could not import*"])
    write(project, WHOLE_FILE, 'test = "tests/test_x.py"\nsays = "no_such_module"')
    (project.path / "tests" / "test_y.py").write_text("def test_y():\n    pass\n")
    done = run(project, *processes)
    assert done.ret == pytest.ExitCode.OK
    done.stdout.fnmatch_lines(["1 skipped, *", "*1  no_such_module: It is day.*"])


def test_an_entry_allows_its_own_reason_only(project: pytest.Pytester) -> None:
    write(project, IN_A_TEST, 'test = "tests/*"\nsays = "no sun"')
    run(project).assert_outcomes(passed=1, failed=2, xfailed=1)


@PROCESSES
def test_an_entry_without_a_test_is_said(
    project: pytest.Pytester, processes: tuple[str, ...]
) -> None:
    entries = (
        'test = "tests/test_x.py::test_a"\nsays = "moon"',
        'test = "tests/test_x.py::test_gone"\nsays = "moon"',
        'test = "tests/test_gone.py::*"\nsays = "moon"',
        'test = "tests/test_other.py::*"\nsays = "moon"',
    )
    write(project, IN_A_TEST, *entries)
    (project.path / "tests" / "test_other.py").write_text("def test_o():\n    pass\n")
    # A run of one file says nothing about the other one's tests, nor does `-k` about any.
    done = run(project, *processes, "tests/test_x.py", "-k", "test_c")
    done.assert_outcomes(passed=1, deselected=3 if not processes else 0)
    said = [line for line in done.outlines if "is the name of no test" in line]
    assert [line.split()[1] for line in said] == [
        "tests/test_x.py::test_gone",
        "tests/test_gone.py::*",
    ]


@pytest.mark.parametrize(
    "entry",
    ['test = "*"', 'test = "*"\nsays = ""', 'test = "*"\nsays = "moon"\nsince = "1969"'],
    ids=["lacks", "empty", "another"],
)
def test_an_entry_that_is_not_whole_is_refused(project: pytest.Pytester, entry: str) -> None:
    write(project, IN_A_TEST, entry)
    done = run(project)
    assert done.ret == pytest.ExitCode.USAGE_ERROR
    done.stderr.fnmatch_lines(["*entry 1 needs text in*runs_when*"])


def test_every_entry_of_ours_names_a_test_that_exists() -> None:
    """Oracle: the functions in the files, as Python's own parser reads them."""
    allowed = read_allowed(LIST)
    assert allowed
    tests = set()
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        file = path.relative_to(ROOT).as_posix()
        tests.add(file)
        tree = ast.parse(path.read_text("utf-8"))
        names = (node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))
        tests.update(f"{file}::{name}" for name in names if name.startswith("test_"))
    assert [entry for entry in allowed if not fnmatch.filter(tests, entry.test)] == []
