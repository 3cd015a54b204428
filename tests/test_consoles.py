"""Both programs on consoles of other encodings, closed or without a reader.

Oracle: the same command on a UTF-8 console, Python's codecs, and the statuses of a shell.
"""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from made_results import made_results
from small_captures import CaptureMaker

from hwp_bench.base.console import expressed, print_document, settle, tell
from hwp_bench.base.images import write_image
from hwp_bench.base.tables import Column, Table, print_table
from hwp_bench.cli.main import main
from hwp_bench.results import write_results
from wildghand.cli.main import main as wildghand

ROOT = Path(__file__).parents[1]
#: Runs a command of one of the programs, on a console of an encoding; returns status and bytes.
Runs = Callable[[str, list[str]], tuple[int, bytes, bytes]]
#: Commands that print tables, with names for what the fixtures make.
COMMANDS = (
    "list",
    "table A B",
    "table A B --by rank",
    "table A B --by cost",
    "table A B --by captures",
    "table A B --by perturbations",
    "table A B --by details",
    "table A B --by micro",
    "table A B --by seeds",
    "table --published",
    "table --published --paper 5",
    "compare A B",
    "curves A B -o COST",
    "data check CAPTURE",
    "evaluate ENTRY --capture CAPTURE -o RUN",
    "verify RUN --capture CAPTURE",
    "list scenes",
    "dev plan capture4 --no-probe",
    "wildghand network compact",
)


@pytest.fixture
def on_console(monkeypatch: pytest.MonkeyPatch) -> Runs:
    def run(encoding: str, words: list[str]) -> tuple[int, bytes, bytes]:
        out, err = io.BytesIO(), io.BytesIO()
        program = wildghand if words[0] == "wildghand" else main
        with monkeypatch.context() as patch:
            # Strict, as standard output is: what cannot be encoded is an error.
            streams = io.TextIOWrapper(out, encoding), io.TextIOWrapper(err, encoding)
            patch.setattr(sys, "stdout", streams[0])
            patch.setattr(sys, "stderr", streams[1])
            patch.delenv("COLUMNS", raising=False)
            status = program(words[1:] if words[0] == "wildghand" else words)
        for stream in streams:
            stream.flush()
        return status, out.getvalue(), err.getvalue()

    return run


@pytest.fixture
def places(make_capture: CaptureMaker, tmp_path: Path) -> dict[str, str]:
    capture = make_capture(frames=20, size=48)
    entry = tmp_path / "entry"
    for frame in (18, 19):
        write_image(entry / "predictions" / "tiny" / f"{frame:06d}.png", capture.frame(frame))
    (entry / "method.toml").write_text(
        'schema = "hwp-method/1"\ntraining = "none"\n'
        'name = "truth"\n[entry]\npredictions = "predictions"\n'
    )
    for name, level in (("A", 25.0), ("B", 20.0)):
        made = made_results(name.lower(), lambda c, f, s, level=level: level + c + 0.1 * f)
        write_results(tmp_path / name / "results.json", made)
    found = {name: str(tmp_path / name) for name in ("A", "B", "COST", "RUN")}
    return {**found, "CAPTURE": str(capture.root), "ENTRY": str(entry)}


@pytest.mark.parametrize("command", COMMANDS)
def test_tables_are_printed_in_every_encoding(
    command: str, places: dict[str, str], on_console: Runs
) -> None:
    words = [places.get(word, word) for word in command.split()]
    if words[0] == "verify":
        first = ["evaluate", places["ENTRY"], "--capture", places["CAPTURE"], "-o", places["RUN"]]
        assert on_console("ascii", first)[0] == 0
    said = {code: on_console(code, words) for code in ("utf-8", "latin-1", "ascii", "cp1252")}
    status, expected = said["utf-8"][0], said["utf-8"][1].decode()
    assert status == 0
    assert expected.strip()
    numbers = re.findall(r"\d+\.\d+", expected)
    widest = max(map(len, expected.splitlines()))
    for code, (ended, out, _) in said.items():
        text = out.decode("utf-8" if command.startswith("dev plan") else code)
        assert ended == status
        if "wildghand" not in command and "evaluate" not in command:
            assert re.findall(r"\d+\.\d+", text) == numbers
        # Whatever we print ourselves has a form in ASCII; nothing is widened by it.
        assert not re.search(r"\\[ux]", text)
        assert max(map(len, text.splitlines())) <= widest + 1


def test_results_are_whole_although_their_names_are_of_another_script(
    places: dict[str, str], on_console: Runs, tmp_path: Path
) -> None:
    manifest = Path(places["ENTRY"]) / "method.toml"
    text = manifest.read_text("utf-8").replace('"truth"\n', '"truth"\ntitle = "Wahrheit ß 手"\n')
    manifest.write_text(text, "utf-8")
    words = ["evaluate", places["ENTRY"], "--capture", places["CAPTURE"], "-o", places["RUN"]]
    status, out, _ = on_console("ascii", words)
    assert status == 0
    assert rb"Wahrheit \xdf \u624b" in re.sub(rb"\s+", b" ", out)
    assert (tmp_path / "RUN" / "results.json").is_file()
    assert "Wahrheit ß 手" in (tmp_path / "RUN" / "tables" / "overall.md").read_text("utf-8")


@pytest.mark.parametrize("code", ["ascii", "latin-1"])
@pytest.mark.parametrize("form", ["md", "tex", "csv", "json"])
def test_documents_have_the_same_bytes_everywhere(
    code: str, form: str, places: dict[str, str], on_console: Runs
) -> None:
    results = made_results("é", lambda c, f, s: 20.0 + c)
    titled = replace(results, method=replace(results.method, title="Größe 手"))
    write_results(Path(places["A"]) / "results.json", titled)
    words = ["table", places["A"], "--format", form]
    expected = on_console("utf-8", words)
    assert on_console(code, words)[:2] == expected[:2]
    assert ("Größe 手" in expected[1].decode()) == (form != "json")


def test_a_table_in_ascii_is_a_table(monkeypatch: pytest.MonkeyPatch) -> None:
    columns = (
        Column("Method"),
        Column("PSNR", 1, True, "Maß"),
        Column("distance", 1, False, "Maß"),
    )
    table = Table("T – ü", columns, (("a", 2.0, 0.5), ("b", None, 1.0)), ("±",))
    out = io.BytesIO()
    stream = io.TextIOWrapper(out, "ascii")
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", stream)
        print_table(table, 60)
    stream.flush()
    lines = out.getvalue().decode("ascii").splitlines()
    assert lines == [
        r"T - \xfc",
        r"        --- Ma\xdf ---",
        r"        PSNR  distance",
        r"Method     ^         v",
        r"----------------------",
        r"a       2.0       0.5*",
        r"b         -       1.0",
        r"+-",
        r"^ higher is better, v lower is better.",
        r"* the best of the rows on the same data.",
    ]


def test_expressed_is_what_the_codec_can_hold() -> None:
    text = "─━–—−↑↓×±≤≥°µ✓✕…‘’“”\u00a0é手\U0001f600\udcff"
    for code in ("ascii", "latin-1", "cp1252", "koi8-r", "utf-8"):
        held = expressed(text, code)
        assert held.encode(code).decode(code) == held
        assert expressed(held, code) == held
    assert expressed("é×", "latin-1") == "é×"
    assert expressed("é手", "ascii") == r"\xe9\u624b"


def test_what_draws_on_terminals_has_its_place() -> None:
    """`rich` chooses its own characters; only there are they fitted to an encoding."""
    users = {
        path.relative_to(ROOT).as_posix()
        for package in ("hwp_bench", "wildghand", "baselines")
        for path in (ROOT / package).rglob("*.py")
        if re.search(r"^\s*(from|import) rich\b", path.read_text("utf-8"), re.MULTILINE)
    }
    assert users == {"hwp_bench/base/tables.py", "hwp_bench/base/console.py"}


def test_what_a_stream_refuses_does_not_stop_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    read, write = os.pipe()
    os.close(read)
    with open(write, "w", encoding="ascii") as stream, monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", stream)
        tell("nobody reads é")
        tell("and again")
        assert settle(stream) is None  # it is silent now
        patch.setattr(sys, "stderr", None)
        tell("there is no stream")
        patch.setattr(sys, "stdout", io.StringIO())
        print_document("é\n")
        assert sys.stdout.getvalue() == "é\n"


def shell(script: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """Run a script of bash: $B is `hwp-bench`, $W `wildghand`, 3 a pipe that nobody reads."""
    names = ("PYTHONUTF8", "PYTHONIOENCODING", "PYTHONUNBUFFERED", "LC_ALL", "LANG", "LC_CTYPE")
    kept = {name: value for name, value in os.environ.items() if name not in names}
    programs = {"B": "hwp_bench", "W": "wildghand"}
    start = [f'{name}="{sys.executable} -m {of}.cli.main"' for name, of in programs.items()]
    lines = [*start, "exec 3> >(exec true)", "wait $!", script]
    return subprocess.run(
        ["bash", "-c", "\n".join(lines)],
        cwd=cwd,
        env={**kept, **environment},
        capture_output=True,
        check=False,
        timeout=120,
    )


@pytest.mark.parametrize(
    ("script", "status", "out", "err"),
    [
        ("$B list perturbations >&-", 0, "", ""),
        ("$B list perturbations 2>&-", 0, "Perturbations", ""),
        ("$B list perturbations --json <&- 2>&-", 0, "{", ""),
        ("$B data check x >&-", 1, "", "checking captures"),
        ("$B data check x 2>&-", 1, "x: NOT SOUND", ""),
        ("$B data check x --json >&- 2>&- <&-", 1, "", ""),
        ("$B list perturbations 2>/dev/full", 0, "Perturbations", ""),
        ("$B list perturbations >/dev/full", 1, "", "standard output: No space left on device"),
        ("$B list perturbations >&3", 141, "", ""),
        ("$B --help >&3", 141, "", ""),
        ("$B table --help >&3", 141, "", ""),
        ("$B nothing >&3", 2, "", "there is no command"),
        ("$B data check x 2>&3", 1, "x: NOT SOUND", ""),
        ("$B --help >&-", 0, "", ""),
        ("$W --help 2>&-", 0, "usage: wildghand", ""),
    ],
)
def test_streams_that_are_closed_full_or_without_reader(
    script: str, status: int, out: str, err: str, tmp_path: Path
) -> None:
    done = shell(script, tmp_path)
    said = done.stderr.decode()
    assert done.returncode == status, said
    assert done.stdout.decode().startswith(out)
    assert err in said
    assert bool(done.stdout) == bool(out)
    assert bool(said) == bool(err)
    assert "Traceback" not in said
    assert "Exception ignored" not in said


def test_a_file_does_not_take_the_place_of_a_closed_stream(tmp_path: Path) -> None:
    """Handles 0 to 2 stay occupied; else what a library prints would go into a file of ours."""
    script = (
        "import os, sys\n"
        "from hwp_bench.base.console import standard_streams\n"
        "with standard_streams():\n"
        "    file = open('kept', 'w')\n"
        "    os.write(1, b'noise'); os.write(2, b'noise'); print('noise')\n"
        "    print('noise', file=sys.stderr)\n"
        "    os.system('echo noise; echo noise >&2')\n"
        "    file.write('result'); file.close()\n"
        "assert sys.stdout is None and sys.stderr is None and sys.stdin is None\n"
    )
    (tmp_path / "noisy.py").write_text(script)
    done = shell(f"{sys.executable} noisy.py <&- >&- 2>&-", tmp_path, PYTHONPATH=str(ROOT))
    assert done.returncode == 0
    assert (tmp_path / "kept").read_text() == "result"


@pytest.mark.parametrize(
    "environment",
    [
        {"LC_ALL": "C", "PYTHONUTF8": "0"},
        {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONIOENCODING": "latin-1"},
    ],
    ids=str,
)
def test_file_names_and_files_are_utf_8_in_every_locale(
    environment: dict[str, str], make_capture: CaptureMaker, tmp_path: Path
) -> None:
    make_capture(frames=12).root.rename(tmp_path / "größe")
    script = (
        "$B table --published --format md > table.md && $B table --published"
        " && $B data show größe --frame-count 1 -o 手/ü.png"
    )
    done = shell(script, tmp_path, **environment)
    assert done.returncode == 0, done.stderr.decode()
    assert (tmp_path / "手" / "ü.png").is_file()
    assert "SSIM ↑" in (tmp_path / "table.md").read_text("utf-8")
    code = environment.get("PYTHONIOENCODING", "ascii")
    printed = done.stdout.decode(code)
    assert "-" * 20 in printed
    assert printed.splitlines()[-1] == expressed("手/ü.png", code)
