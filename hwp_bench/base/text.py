"""Text for a person: real Unicode, without characters that steer a terminal, and bounded."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence

from hwp_bench.base.errors import UsageError

#: Control characters except tab and line feed, the marks that reverse the direction of writing,
#: and halves of surrogate pairs, which no file can hold as UTF-8; as a set of characters in a
#: regular expression (without its brackets).
ODD_CHARACTERS = r"\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff"
_ODD = re.compile(f"[{ODD_CHARACTERS}]")


def bounded(items: Sequence[object], most: int = 12) -> str:
    """Return items separated by commas, at most some of them, and how many more there are."""
    text = ", ".join(str(item) for item in items[:most])
    return text if len(items) <= most else f"{text} and {len(items) - most} more"


def has_odd_characters(text: str) -> bool:
    """Whether a text holds one of `ODD_CHARACTERS`."""
    return _ODD.search(text) is not None


def is_unicode(text: str) -> bool:
    """Whether a text can be written as UTF-8: it holds no half of a surrogate pair."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def check_name(path: str | os.PathLike[str]) -> None:
    """Refuse the name of a file or folder that is not UTF-8.

    Libraries that read and write files in C++ take such a name for another one.

    Raises:
        UsageError: the name holds bytes that are not UTF-8.
    """
    text = os.fspath(path)
    if not is_unicode(text):
        raise UsageError("is not UTF-8", where=shown(text), remedy="Rename the file or folder.")


def shown(text: str) -> str:
    """Return a text that can be printed on a terminal: odd characters become `?`."""
    return _ODD.sub("?", text)


def one_line(text: str, most: int = 1000) -> str:
    """Return a text as a record keeps it: one line without odd characters, of bounded length."""
    return shown(text[:most]).replace("\n", " ")
