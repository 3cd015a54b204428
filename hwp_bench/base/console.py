"""The standard streams of a program: whatever their encoding or end, they do not stop its work."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import select
import sys
from collections.abc import Iterator
from typing import TextIO

#: What characters that we print become where the encoding of a stream lacks them.
_FORMS = {
    "─": "-",
    "━": "-",
    "–": "-",
    "—": "-",
    "−": "-",
    "↑": "^",
    "↓": "v",
    "×": "x",
    "±": "+-",
    "≤": "<=",
    "≥": ">=",
    "°": " deg",
    "µ": "u",
    "✓": "yes",
    "✕": "x",
    "…": "...",
    "‘": "'",
    "’": "'",
    "“": '"',
    "”": '"',
    "\u00a0": " ",
}
#: The standard streams by the number of their handle.
_STREAMS = ("stdin", "stdout", "stderr")


def encoding_of(stream: TextIO | None) -> str:
    """Return the name of a stream's encoding; UTF-8 for one that has none."""
    return getattr(stream, "encoding", None) or "utf-8"


def expressed(text: str, encoding: str) -> str:
    """Return a text as an encoding can hold it.

    Args:
        text: any text.
        encoding: of a terminal, a pipe or a file.

    Returns:
        The text, with similar characters of ASCII for dashes, rules, arrows and signs that the
        encoding lacks, and backslash escapes as Python's for every other character.
    """
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        return "".join(_expressed(char, encoding) for char in text)
    return text


def _expressed(char: str, encoding: str) -> str:
    try:
        char.encode(encoding)
    except UnicodeEncodeError:
        return _FORMS.get(char) or char.encode("ascii", "backslashreplace").decode("ascii")
    return char


def print_document(text: str) -> None:
    """Print what is a file by itself, such as a table in LaTeX.

    Off a terminal it is UTF-8 whatever the locale is, as the files are that we write.
    """
    buffer = getattr(sys.stdout, "buffer", None)
    if buffer is None or sys.stdout.isatty():
        print(expressed(text, encoding_of(sys.stdout)), end="")
        return
    sys.stdout.flush()
    buffer.write(text.encode("utf-8", "backslashreplace"))


def in_utf8_mode(program: str) -> None:
    """Start this process again in Python's UTF-8 mode, where the locale is of another encoding.

    Python cannot change the encoding of file names while it runs. In another one than UTF-8 a name
    with an accent cannot be text (ASCII), or is another name for libraries in C++ (Latin-1). The
    standard streams keep the encoding that they have. Nothing is done in UTF-8, where the user
    chose `-X utf8`, or where the process is not one of this program (a script, a test).

    Args:
        program: its name.
    """
    if sys.getfilesystemencoding().lower().replace("-", "") == "utf8" or os.name != "posix":
        return
    main = getattr(sys.modules.get("__main__"), "__file__", None)
    if main is None or os.path.basename(main) not in (program, "main.py"):
        return
    if "utf8" in sys._xoptions or not sys.executable:
        return
    streams = f"{encoding_of(sys.stdout)}:backslashreplace"
    os.environ.setdefault("PYTHONIOENCODING", streams)
    os.environ["PYTHONUTF8"] = "1"
    os.execv(sys.executable, [sys.executable, "-X", "utf8", *sys.orig_argv[1:]])


@contextlib.contextmanager
def standard_streams() -> Iterator[None]:
    """Let a block print whatever it wants.

    What the encoding of standard output lacks becomes a backslash escape. A stream that the caller
    has closed (`>&-`) takes what is printed and drops it, and its handle is in use, so that no file
    that is opened later gets what others print.
    """
    closed = [name for name in _STREAMS if getattr(sys, name) is None]
    errors = getattr(sys.stdout, "errors", None)
    with contextlib.ExitStack() as opened:
        if closed:
            _fill_handles()
        for name in closed:
            mode = "r" if name == "stdin" else "w"
            stream = opened.enter_context(open(os.devnull, mode, encoding="utf-8"))
            setattr(sys, name, stream)
            opened.callback(setattr, sys, name, None)
        changed = sys.stdout
        if isinstance(changed, io.TextIOWrapper):
            changed.reconfigure(errors="backslashreplace")
        try:
            yield
        finally:
            if isinstance(changed, io.TextIOWrapper) and errors and not changed.closed:
                with contextlib.suppress(OSError):
                    changed.reconfigure(errors=errors)


def _fill_handles() -> None:
    """Open what is closed of the handles 0, 1 and 2, for this process and its children."""
    for handle in range(len(_STREAMS)):
        try:
            os.fstat(handle)
        except OSError:
            # The system gives the lowest free handle, which is this one.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)


def settle(stream: TextIO | None) -> OSError | None:
    """Write out what a stream holds.

    Returns:
        None; or why it cannot be written, and then the stream is silent from now on, so that
        Python does not complain when it ends.
    """
    if stream is None or stream.closed:
        return None
    try:
        stream.flush()
    except OSError as error:
        _silence(stream)
        return error
    if _reader_gone(stream):
        _silence(stream)
        return BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))
    return None


def _silence(stream: TextIO) -> None:
    with contextlib.suppress(OSError, ValueError):
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, stream.fileno())
        os.close(nothing)


def _reader_gone(stream: TextIO) -> bool:
    """Whether a stream is a pipe that nobody reads: what failed before is in no buffer."""
    if not hasattr(select, "poll"):
        return False
    with contextlib.suppress(OSError, ValueError):
        watched = select.poll()
        watched.register(stream, 0)
        return any(event & select.POLLERR for _, event in watched.poll(0))
    return False


def tell(text: str) -> None:
    """Print a line on standard error; where it cannot be printed, the work goes on without."""
    stream = sys.stderr
    if stream is None or stream.closed:
        return
    try:
        print(expressed(text, encoding_of(stream)), file=stream, flush=True)
    except OSError:
        settle(stream)


def on_terminal(stream: TextIO | None) -> bool:
    """Whether a stream is a terminal; one that is closed is none."""
    return stream is not None and not stream.closed and stream.isatty()
