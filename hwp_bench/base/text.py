"""Text for a person: real Unicode, without characters that steer a terminal, and bounded."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable, Sequence

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


def nearest(wrong: str, known: Iterable[str], *, most: int = 1, cutoff: float = 0.6) -> list[str]:
    """Return the known names that are most like a wrong one, the closest first; often none.

    Args:
        wrong: what was given.
        known: the names that there are.
        most: how many are returned at most.
        cutoff: how alike they must be, from 0 to 1.
    """
    return difflib.get_close_matches(wrong[:200], list(known), n=most, cutoff=cutoff)


def did_you_mean(wrong: str, known: Iterable[str], *, cutoff: float = 0.6) -> str:
    """Return `Did you mean 'NAME'?` of the nearest known name; empty where none is near."""
    near = nearest(wrong, known, cutoff=cutoff)
    return f"Did you mean {near[0]!r}?" if near else ""


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
