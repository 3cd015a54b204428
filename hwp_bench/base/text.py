"""Text from others: finds and replaces characters that steer a terminal or reverse a line."""

from __future__ import annotations

import re

#: Control characters except tab and line feed, and the marks that reverse the direction of
#: writing, as a set of characters in a regular expression (without its brackets).
ODD_CHARACTERS = "\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069"
_ODD = re.compile(f"[{ODD_CHARACTERS}]")


def has_odd_characters(text: str) -> bool:
    """Whether a text holds control characters (tab and line feed apart) or direction marks."""
    return _ODD.search(text) is not None


def shown(text: str) -> str:
    """Return a text that can be printed on a terminal: odd characters become `?`."""
    return _ODD.sub("?", text)
