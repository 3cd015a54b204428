"""Method directories: finding them, reading and checking `method.toml`."""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadMethod, UsageError, nearest
from hwp_bench.base.files import inside
from hwp_bench.base.packages import PACKAGES, data_folder
from hwp_bench.base.records import (
    Line,
    check_json_values,
    flattened,
    parse_record,
    parse_toml,
    without_schema,
)
from hwp_bench.methods.contents import method_digest
from hwp_bench.methods.settings import class_settings
from hwp_bench.taxonomy import SIZED_LIKE

#: Version of the method contract.
SCHEMA = "hwp-method/1"
#: Name of the file that makes a folder a method directory.
MANIFEST = "method.toml"
#: Largest `method.toml`, in bytes.
MAX_BYTES = 64 * 1024
#: Preset that is used when none is asked for.
DEFAULT_PRESET = "default"
#: Ways to enter a method; a manifest has exactly one.
ENTRY_KINDS = ("python", "command", "predictions")


def _matching(pattern: str, description: str) -> Meta:
    return Meta(pattern=rf"\A(?:{pattern})\Z", description=description)


_MethodName = Annotated[
    str,
    _matching(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", "a name of letters, digits and . _ -"),
]
_PythonEntry = Annotated[str, _matching(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", "module:callable")]
_Words = Annotated[list[str], Meta(min_length=1, description="a list of words")]
_SwitchName = Annotated[
    str, _matching(r"[a-z0-9][a-z0-9-]{0,31}", "a name of lower-case letters, digits and hyphens")
]
_SettingName = Annotated[
    str, _matching(r"[A-Za-z_]\w{0,63}(\.[A-Za-z_]\w{0,63}){0,7}", "a name of a setting")
]
_SettingsItem = Annotated[
    str,
    _matching(
        r"[A-Za-z_]\w{0,63}(\.[A-Za-z_]\w{0,63}){0,7}(:[A-Za-z_]\w{0,63})?",
        "a name of a setting, or module:Class",
    ),
]
_KindName = Annotated[str, _matching(r"[a-z][a-z0-9-]{0,31}", "a word of letters and digits")]
_SwitchSettings = Annotated[
    dict[_SettingName, Any], Meta(min_length=1, description="a table of at least one setting")
]


@dataclass(frozen=True)
class Switch:
    """One component of a method that can be taken out, or one alternative to how it works."""

    #: Short name: lower-case letters, digits, `-`.
    name: str
    #: Name in tables.
    title: str
    #: One sentence.
    description: str
    #: Settings that override the preset in the switch's variant.
    settings: Mapping[str, Any]
    #: False: the variant lacks a component (`settings_off`). True: an alternative takes the place
    #: of what the method does otherwise (`settings_on`).
    alternative: bool

    @property
    def variant_name(self) -> str:
        """Name of the variant that this switch makes: `no-dpd`, `binary-mask`."""
        return self.name if self.alternative else f"no-{self.name}"


@dataclass(frozen=True)
class MethodManifest:
    """A checked `method.toml`."""

    #: The method directory.
    root: Path
    #: Short name: letters, digits, `.`, `_`, `-`.
    name: str
    #: Name in tables.
    title: str
    #: One sentence about the method.
    description: str
    #: `python`, `command` or `predictions`.
    kind: str
    #: `module:callable`; or the words of a command; or the folder of predictions.
    entry: str | tuple[str, ...]
    #: Settings by preset.
    presets: Mapping[str, Mapping[str, Any]]
    #: Components and alternatives for ablations, by name, in the order of the file.
    switches: Mapping[str, Switch] = field(default_factory=dict)
    #: Names of the components that an ablation crosses when nothing is asked for; empty where
    #: the file does not say.
    crossed: tuple[str, ...] = ()
    #: Who made it; empty where the file does not say.
    authors: str = ""
    #: Terms of use; empty where the file does not say.
    licence: str = ""
    #: Its page; empty where the file does not say.
    url: str = ""
    #: Names of its settings, dotted within tables; empty where the file does not say. A name
    #: stands for everything below it.
    settings: tuple[str, ...] = ()
    #: Settings whose value may be `KIND:PATH`, a file or folder of a person's: the kinds, by name.
    files: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    #: `module:callable` that checks such files before a method that ships is run; may be empty.
    check_files: str = ""

    def check_setting_names(self, values: Mapping[str, Any], field: str = "settings") -> None:
        """Refuse a setting that the method does not have, before anything runs.

        Methods that do not list their settings take any; the values are the method's to check.

        Args:
            values: settings by name; `a.b` and tables within tables are the same.
            field: where they come from, for the message.

        Raises:
            BadMethod: a name is not in `settings`; the message says which one is close.
        """
        known, tables = set(self.settings), {name.rpartition(".")[0] for name in self.settings}
        for name, _ in flattened(values) if self.settings else ():
            above = itertools.accumulate(name.split("."), "{}.{}".format)
            if name in tables or not known.isdisjoint(above):
                continue
            raise BadMethod(
                f"{name[:100]!r} is not a setting of {self.name}",
                where=self.root / MANIFEST,
                field=field,
                remedy=self._nearest_settings(name),
            )

    def doubt_setting_names(self, values: Mapping[str, Any], field: str = "settings") -> None:
        """Refuse a name that is nearly one of the presets', where the method lists no settings.

        Such a method takes any name, so that a mistyped one would run without an effect. A name
        that resembles none is let through, and said.

        Args:
            values: a person's settings by name.
            field: where they come from, for the message.

        Raises:
            BadMethod: a name is nearly, but not, one that a preset or switch has.
        """
        tables = [*self.presets.values(), *(switch.settings for switch in self.switches.values())]
        known = {name for table in tables for name, _ in flattened(table)}
        if self.settings or not known:
            return
        for name, _ in flattened(values):
            if name in known:
                continue
            close = nearest(name, sorted(known), most=3, cutoff=0.75)
            if not close:
                notice(f"{field}: {name}: {self.name} does not list its settings; not checked")
                continue
            raise BadMethod(
                f"{name[:100]!r} is in no preset or switch of {self.name}",
                where=self.root / MANIFEST,
                field=field,
                remedy=f"Did you mean {' or '.join(map(repr, close))}? If it is a setting, list "
                "the names of all under `settings`.",
            )

    def _nearest_settings(self, wrong: str) -> str:
        """Say which setting was probably meant, or which there are in its place."""
        last = {name.rpartition(".")[2]: name for name in self.settings}
        close = nearest(wrong, self.settings, cutoff=0.75)
        close = close or [last[word] for word in nearest(wrong, last)]
        if close:
            return f"Did you mean {close[0]!r}?"
        table = wrong.rpartition(".")[0]
        known = [name for name in self.settings if name.rpartition(".")[0] == table]
        if not table or not known:
            known = list(dict.fromkeys(name.partition(".")[0] for name in self.settings))
        return f"Known: {', '.join(known)}."

    def preset(self, name: str | None, suite: str = "") -> str:
        """Return the name of the preset to use.

        Args:
            name: what was asked for; None takes the one named like the suite where the method
                has it, else that of a suite of the same size, else `default`.
            suite: name of the suite.

        Raises:
            BadMethod: there is no such preset.
        """
        if name is None:
            fitting = (suite, SIZED_LIKE.get(suite, ""))
            return next((name for name in fitting if name in self.presets), DEFAULT_PRESET)
        if name not in self.presets and name != DEFAULT_PRESET:
            raise BadMethod(
                f"has no preset {name!r}",
                where=self.root / MANIFEST,
                field="presets",
                remedy=f"It has: {', '.join(self.presets) or DEFAULT_PRESET}.",
            )
        return name

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of every file of the method: what was run."""
        return method_digest(self.root)


def find_method(text: str) -> Path:
    """Find a method directory by path, or by the name of one that ships with the toolkit.

    Args:
        text: a path such as `my_method/`; or `plain`, `baselines/plain`, `wildghand`.

    Raises:
        BadMethod: there is no such directory.
    """
    if (Path(text) / MANIFEST).is_file():
        return Path(text)
    name = Path(text).as_posix().removeprefix("baselines/")
    for folder in _shipped_folders():
        if folder.name == name:
            return folder
    raise BadMethod(
        f"is not a method directory: it has no {MANIFEST}",
        where=text,
        remedy="`hwp-bench list methods` shows the ones that ship with the toolkit.",
    )


def shipped_methods() -> list[MethodManifest]:
    """Return the methods that ship with the toolkit: the reference method and the baselines."""
    return [read_manifest(folder) for folder in _shipped_folders()]


def _shipped_folders() -> list[Path]:
    folders = [PACKAGES / "wildghand", *sorted(data_folder("baselines").iterdir())]
    return [folder for folder in folders if (folder / MANIFEST).is_file()]


def read_manifest(path: str | os.PathLike[str]) -> MethodManifest:
    """Read and check the `method.toml` of a method directory.

    Raises:
        BadMethod: it is missing, too large or not TOML, or a field is unknown, missing or wrong.
    """
    root = Path(path)
    where = root / MANIFEST
    if not where.is_file():
        raise BadMethod(f"is not a method directory: it has no {MANIFEST}", where=root)
    if where.stat().st_size > MAX_BYTES:
        raise BadMethod(f"is larger than {MAX_BYTES} bytes", where=where)
    try:
        text = where.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise BadMethod(f"is not valid TOML ({error})", where=where) from error
    except OSError as error:
        raise BadMethod(f"cannot be read ({error.strerror})", where=where) from error
    value = parse_toml(text, where=where, error=BadMethod)
    fields = without_schema(value, SCHEMA, where=where, error=BadMethod)
    authors = fields.get("authors")
    if isinstance(authors, list) and all(isinstance(name, str) for name in authors):
        fields["authors"] = ", ".join(authors)
    if isinstance(fields.get("settings"), str):
        fields["settings"] = [fields["settings"]]
    table = parse_record(_Manifest, fields, where=where, error=BadMethod)
    kind, entry = table.entry.given[0]
    if table.entry.predictions is not None:
        inside(root, table.entry.predictions)
    _check_plain(table.presets, where, "presets")
    manifest = MethodManifest(
        root=root,
        name=table.name,
        title=table.name if table.title is None else table.title,
        description=table.description,
        kind=kind,
        entry=tuple(entry) if isinstance(entry, list) else entry,
        presets=table.presets,
        switches=_switches(table.switches, where),
        crossed=tuple(table.crossed),
        authors=table.authors,
        licence=table.licence,
        url=table.url,
        settings=_setting_names(root, table.settings),
        files={name: tuple(kinds) for name, kinds in table.files.items()},
        check_files=table.check_files or "",
    )
    manifest.check_setting_names(manifest.files, "files")
    for name, preset in manifest.presets.items():
        manifest.check_setting_names(preset, f"presets.{name}")
    for name, switch in manifest.switches.items():
        manifest.check_setting_names(switch.settings, f"switches.{name}")
    _check_crossed(manifest, where)
    return manifest


def _setting_names(root: Path, items: list[str]) -> tuple[str, ...]:
    """Return the names of settings; an item `module:Class` stands for the fields of a dataclass."""
    return tuple(
        name for item in items for name in (class_settings(root, item) if ":" in item else [item])
    )


def _check_crossed(manifest: MethodManifest, where: Path) -> None:
    """Refuse names in `crossed` that do not name a component, or are there twice."""
    components = [item.name for item in manifest.switches.values() if not item.alternative]
    for name in manifest.crossed:
        if name not in components or manifest.crossed.count(name) > 1:
            raise BadMethod(
                f"{name!r} is there twice"
                if name in components
                else f"{name!r} is not a component",
                where=where,
                field="crossed",
                remedy=f"Name each of these at most once: {', '.join(components) or 'none'}.",
            )


def _switches(tables: Mapping[str, _SwitchTable], where: Path) -> dict[str, Switch]:
    switches = {}
    for name, table in tables.items():
        kind = "settings_on" if table.settings_off is None else "settings_off"
        settings = getattr(table, kind)
        _check_plain(settings, where, f"switches.{name}.{kind}")
        title = name if table.title is None else table.title
        switches[name] = Switch(
            name, title, table.description, settings, alternative=kind == "settings_on"
        )
    names = [switch.variant_name for switch in switches.values()]
    for name in names:
        if names.count(name) > 1:
            raise BadMethod(f"two switches make a variant {name!r}", where=where, field="switches")
    return switches


def _check_plain(value: Any, where: Path, field: str) -> None:
    check_json_values(value, where=where, field=field, error=BadMethod)


@dataclass(frozen=True)
class _Entry:
    """The table `entry` of the file."""

    python: _PythonEntry | None = None
    command: _Words | None = None
    predictions: str | None = None

    def __post_init__(self) -> None:
        if len(self.given) != 1:
            raise UsageError(f"must have exactly one of {', '.join(ENTRY_KINDS)}")

    @property
    def given(self) -> list[tuple[str, Any]]:
        """Kind and value of every entry that the file has."""
        values = (self.python, self.command, self.predictions)
        pairs = zip(ENTRY_KINDS, values, strict=True)
        return [(kind, value) for kind, value in pairs if value is not None]


@dataclass(frozen=True)
class _SwitchTable:
    """One table of `switches` of the file."""

    title: Line | None = None
    description: Line = ""
    settings_off: _SwitchSettings | None = None
    settings_on: _SwitchSettings | None = None

    def __post_init__(self) -> None:
        if (self.settings_off is None) == (self.settings_on is None):
            raise UsageError(
                "must have exactly one of settings_off and settings_on",
                remedy="settings_off takes a component out; settings_on puts an alternative in.",
            )


@dataclass(frozen=True)
class _Manifest:
    """The fields of the file, but for its schema."""

    name: _MethodName
    entry: _Entry
    title: Line | None = None
    description: Line = ""
    authors: Line = ""
    licence: Line = ""
    url: Line = ""
    settings: list[_SettingsItem] = field(default_factory=list)
    files: dict[_SettingName, list[_KindName]] = field(default_factory=dict)
    check_files: _PythonEntry | None = None
    presets: dict[str, dict[str, Any]] = field(default_factory=dict)
    switches: dict[_SwitchName, _SwitchTable] = field(default_factory=dict)
    crossed: Annotated[list[_SwitchName], Meta(max_length=4)] = field(default_factory=list)
