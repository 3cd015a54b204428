"""The switches of a method: components that an ablation takes out, alternatives it puts in."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import BadMethod
from hwp_bench.base.text import has_odd_characters
from hwp_bench.methods.json_values import check_plain

#: Kinds of switch by the key that holds its settings.
KINDS = ("settings_off", "settings_on")

_KEYS = {"title", "description", *KINDS}
_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,31}")
_SETTING = re.compile(r"[A-Za-z_]\w{0,63}")


@dataclass(frozen=True)
class Switch:
    """One component of a method that can be taken out, or one alternative to how it works."""

    #: Short name: lower-case letters, digits, `-`.
    name: str
    #: Name in tables.
    title: str
    #: One sentence.
    description: str
    #: Settings that override the preset when the switch is thrown.
    settings: Mapping[str, Any]
    #: False: throwing it takes a component out (`settings_off`). True: throwing it puts an
    #: alternative in place of what the method does otherwise (`settings_on`).
    alternative: bool

    @property
    def thrown(self) -> str:
        """What a variant with this switch thrown is called: `no-dpd`, `binary-mask`."""
        return self.name if self.alternative else f"no-{self.name}"


def read_switches(value: Any, where: Path) -> dict[str, Switch]:
    """Check the table `switches` of a `method.toml`.

    Args:
        value: the table: for each switch a table with `title` and `description` (both optional)
            and exactly one of `settings_off` (a component: the overrides that take it out) and
            `settings_on` (an alternative: the overrides that put it in).
        where: the file, for messages.

    Raises:
        BadMethod: it is no such table; the field is named.
    """
    if not isinstance(value, dict):
        raise BadMethod("must be a table of switches", where=where, field="switches")
    switches = {name: _switch(name, item, where) for name, item in value.items()}
    names = [switch.thrown for switch in switches.values()]
    for name in names:
        if names.count(name) > 1:
            raise BadMethod(f"two switches make a variant {name!r}", where=where, field="switches")
    return switches


def _switch(name: str, value: Any, where: Path) -> Switch:
    place = f"switches.{name}"
    if not _NAME.fullmatch(name):
        raise BadMethod(
            "is no name of a switch",
            where=where,
            field=place,
            remedy="Use lower-case letters, digits and hyphens.",
        )
    if not isinstance(value, dict):
        raise BadMethod("must be a table", where=where, field=place)
    for key in value:
        if key not in _KEYS:
            raise BadMethod(
                "is no field of a switch",
                where=where,
                field=f"{place}.{key}",
                remedy=f"Known: {', '.join(sorted(_KEYS))}.",
            )
    kinds = [kind for kind in KINDS if kind in value]
    if len(kinds) != 1:
        raise BadMethod(
            f"must have exactly one of {' and '.join(KINDS)}",
            where=where,
            field=place,
            remedy="settings_off takes a component out; settings_on puts an alternative in.",
        )
    settings = value[kinds[0]]
    if not isinstance(settings, dict) or not settings:
        raise BadMethod(
            "must be a table of at least one setting", where=where, field=f"{place}.{kinds[0]}"
        )
    for setting in settings:
        if not _SETTING.fullmatch(setting):
            raise BadMethod(
                f"{setting!r} is no name of a setting", where=where, field=f"{place}.{kinds[0]}"
            )
    check_plain(settings, where, f"{place}.{kinds[0]}")
    return Switch(
        name=name,
        title=_line(value.get("title", name), where, f"{place}.title"),
        description=_line(value.get("description", ""), where, f"{place}.description"),
        settings=settings,
        alternative=kinds[0] == "settings_on",
    )


def _line(text: Any, where: Path, field: str) -> str:
    if not isinstance(text, str) or len(text) > 1000 or "\n" in text or has_odd_characters(text):
        raise BadMethod("must be one line of at most 1,000 characters", where=where, field=field)
    return text
