"""One command in a forked process with limits, and how it must end."""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

#: Most seconds of processor time of one command: not of the clock, for machines that are busy.
CPU_SECONDS = 20
#: Most seconds by the clock; only a command that waits for something takes as long.
PATIENCE = 240.0
#: Most bytes of memory that a command may take on top of what its process had when it began.
MEMORY = 2 << 30

_TRACE = "Traceback (most recent call last)"
# A line break, a tab and what redraws a line of progress do not steer a terminal.
_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]")
# FFmpeg and libpng write on their own; their lines are not our messages.
_ERROR = re.compile(r"^(hwp-bench|wildghand)[a-z -]*: error: ", re.MULTILINE)


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    #: Exit status; minus the number of the signal that killed it.
    status: int
    #: What it printed.
    out: bytes
    #: What it said on standard error.
    err: bytes
    #: Seconds of processor time.
    seconds: float


def run_forked(
    program: Callable[[Sequence[str]], int], words: Sequence[str], folder: Path
) -> Ended:
    """Run a command in a child of this process, which has every module loaded already.

    Args:
        program: `main` of a command line.
        words: its arguments.
        folder: where it runs; its output goes to `.out` and `.err` there.
    """
    child = os.fork()
    if child == 0:
        _live(program, words, folder)
    deadline = time.monotonic() + PATIENCE
    while True:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() > deadline:
            _kill_group(child)
        time.sleep(0.002)
    _kill_group(child)  # what it left behind
    code = os.waitstatus_to_exitcode(status)
    out, err = ((folder / name).read_bytes() for name in (".out", ".err"))
    for name in (".out", ".err"):
        (folder / name).unlink()
    return Ended(code, out, err, usage.ru_utime + usage.ru_stime)


def _kill_group(child: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(child, signal.SIGKILL)


def _live(program: Callable[[Sequence[str]], int], words: Sequence[str], folder: Path) -> None:
    """The child's whole life; never returns."""
    status = 70
    try:
        os.setsid()
        os.chdir(folder)
        for number, name in ((1, ".out"), (2, ".err")):
            handle = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600)
            os.dup2(handle, number)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
        sys.stderr = os.fdopen(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False)
        pages = int(Path("/proc/self/statm").read_text().split()[5])
        most = MEMORY + pages * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (256 << 20, 256 << 20))
        status = program(words)
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else 1
    except BaseException:
        traceback.print_exc()
    with contextlib.suppress(BaseException):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)


def faults_of(
    ended: Ended, folder: Path, before: frozenset[Path], whole: Sequence[Path]
) -> list[str]:
    """Say what a command did that none may do, a line each; empty for an end as promised.

    Args:
        ended: how it ended.
        folder: where it ran.
        before: everything that lay there before.
        whole: outputs that are there whole or not at all.
    """
    faults = []
    out = ended.out.decode("utf-8", "surrogateescape")
    err = ended.err.decode("utf-8", "surrogateescape")
    if ended.status in (-signal.SIGXCPU, -signal.SIGKILL):
        faults.append(f"was killed after {ended.seconds:.0f} s of processor time")
    elif ended.status not in (0, 1, 2):
        faults.append(f"ended with status {ended.status}")
    if _TRACE in err or _TRACE in out:
        # The exception's line is the first that is not indented after a trace.
        rest = (out + err).rsplit(_TRACE, 1)[1].splitlines()[1:]
        last = next((line for line in rest if line and not line.startswith(" ")), "?")
        faults.append(f"a traceback: {last[:200]}")
    if ended.status in (1, 2):
        messages = len(_ERROR.findall(err))
        if messages > 1:
            faults.append(f"{messages} messages")
        if not messages and not out.strip() and not err.strip():
            faults.append("failed without a word")
    for name, text in (("standard output", out), ("standard error", err)):
        if _CONTROL.search(text):
            faults.append(f"control characters on {name}")
        if re.search("[\udc80-\udcff]", text):
            faults.append(f"{name} is not UTF-8")
    faults += _left_behind(ended.status, folder, before, whole)
    return faults


def _left_behind(
    status: int, folder: Path, before: frozenset[Path], whole: Sequence[Path]
) -> list[str]:
    faults = []
    new = sorted(set(folder.rglob("*")) - before)
    for path in new:
        # A folder of results keeps its lock file; nothing else that is hidden is an output.
        hidden = path.name.startswith(".") or path.name.endswith((".lock", ".old"))
        if hidden and path.name != ".lock":
            faults.append(f"left {path.relative_to(folder)!s:.100} behind")
        elif not hidden and _is_empty(path):
            faults.append(f"left {path.relative_to(folder)!s:.100} empty")
        elif status == 0 and path.suffix == ".json" and path.is_file():
            try:
                json.loads(path.read_text("utf-8"))
            except ValueError as error:
                faults.append(f"wrote {path.relative_to(folder)!s:.100}, not valid JSON: {error}")
    if status != 0:
        faults += [f"failed and wrote {path.name}" for path in whole if path.exists()]
    return [fault.encode("utf-8", "backslashreplace").decode() for fault in faults]


def _is_empty(path: Path) -> bool:
    """Whether a file has no content where one is expected: a method may print nothing."""
    return path.is_file() and path.stat().st_size == 0 and path.suffix not in (".log", ".txt")
