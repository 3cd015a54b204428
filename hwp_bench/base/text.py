"""Text from others: what could steer a terminal or turn a line around is found or taken out."""

from __future__ import annotations

import re

#: Control characters except tab and line feed, and the marks that reverse the direction of
#: writing: what stands between the brackets of a regular expression.
ODD_CHARACTERS = "\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069"
_ODD = re.compile(f"[{ODD_CHARACTERS}]")


def has_odd_characters(text: str) -> bool:
    """Whether a text holds control characters (tab and line feed apart) or direction marks."""
    return _ODD.search(text) is not None


def shown(text: str) -> str:
    """Return a text that can be printed on a terminal: odd characters become `?`."""
    return _ODD.sub("?", text)
