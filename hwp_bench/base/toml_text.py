"""TOML from outside: bounded text, bounded numbers and depth, one message for everything else."""

from __future__ import annotations

import os
import re
import tomllib
from typing import Any

from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.base.text import is_unicode

#: Longest TOML text that is read, characters; the longest scene that ships has 6,000.
MAX_CHARACTERS = 1_000_000
#: Deepest nesting of tables and lists that is read: no format here needs ten levels.
MAX_DEPTH = 32
#: Most bits of an integer. A field has closer bounds, and its reader names it; but Python turns
#: no integer of more than 4,300 digits into text, not even for a message.
MAX_BITS = 256

# A name of more parts than tables may be deep. The parser takes its square in steps: a text of a
# million characters would keep it for an hour.
_DEEP_NAME = re.compile(
    r"""(?<![\w"'-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){128}"""
)


def parse_toml(
    text: str,
    *,
    where: str | os.PathLike[str],
    field: str | None = None,
    error: type[HwpError] = BadInput,
) -> dict[str, Any]:
    """Make tables of TOML text.

    Args:
        text: the content of a file, or a value of a command line.
        where: the file, for messages.
        field: the field that the text is the value of.
        error: raised when something is wrong.

    Raises:
        error: the text is too long, no Unicode or not TOML, nested too deeply, or holds an integer
            of more than `MAX_BITS`. Its cause is a `tomllib.TOMLDecodeError` where the text is
            merely not TOML.
    """

    def refuse(problem: str) -> HwpError:
        return error(problem, where=where, field=field)

    if len(text) > MAX_CHARACTERS:
        raise refuse(f"holds more than the {MAX_CHARACTERS:,} characters that are read")
    if not is_unicode(text):
        raise refuse("holds text that cannot be Unicode")
    if _DEEP_NAME.search(text):
        raise refuse("is nested too deeply")
    try:
        content = tomllib.loads(text)
    except RecursionError as fault:
        raise refuse("is nested too deeply") from fault
    except tomllib.TOMLDecodeError as fault:
        raise refuse(f"is not valid TOML ({str(fault)[:300]})") from fault
    except ValueError as fault:  # Python converts no integer of more than 4,300 digits
        raise refuse("holds an absurdly large number") from fault
    if problem := _excess(content):
        raise refuse(problem)
    return content


def _excess(content: Any) -> str | None:
    """Say what of parsed TOML is out of bounds; level by level, because it may be deep."""
    level = [content]
    for _ in range(MAX_DEPTH):
        below = []
        for holder in level:
            for item in holder.values() if isinstance(holder, dict) else holder:
                if isinstance(item, dict | list):
                    below.append(item)
                elif isinstance(item, int) and item.bit_length() > MAX_BITS:
                    return "holds an absurdly large number"
        if not below:
            return None
        level = below
    return "is nested too deeply"
